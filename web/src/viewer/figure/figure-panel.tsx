/** A figure for papers: the present view, as large as wanted, with colour bar, scale bar and orientation. */
import { useState } from "preact/hooks";
import { asProblem, type Problem } from "../../api/problem";
import { texts } from "../../i18n";
import { ProblemBox } from "../../ui/boxes";
import { Check, NumberField } from "../panels/fields";
import type { PanelProps } from "../viewer";
import { drawFigure } from "./draw-figure";
import { saveFile } from "./save-file";

const en = {
  width: "Width, pixels",
  white: "White background",
  scale: "Colour bar",
  bar: "Scale bar (true at the middle of the view)",
  axes: "Directions of x, y and z",
  save: "Save as PNG",
  drawing: "Drawing …",
};
const it: typeof en = {
  width: "Larghezza, pixel",
  white: "Sfondo bianco",
  scale: "Barra dei colori",
  bar: "Barra di scala (esatta al centro della vista)",
  axes: "Direzioni di x, y e z",
  save: "Salva come PNG",
  drawing: "Disegno …",
};
const t = texts({ en, it });

export default function FigurePanel({ model }: PanelProps) {
  const [wanted, setWanted] = useState({ width: 3000, white: true, scale: true, bar: true, axes: true });
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<Problem | null>(null);
  const save = async (): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      saveFile("figure.png", await drawFigure(model, wanted));
    } catch (thrown) {
      setProblem(asProblem(thrown));
    } finally {
      setBusy(false);
    }
  };
  return (
    <>
      <NumberField
        label={t("width")}
        testid="figure-width"
        min={200}
        max={12000}
        step={1}
        value={wanted.width}
        onChange={(width) => setWanted({ ...wanted, width: Math.round(width) })}
      />
      {(["white", "scale", "bar", "axes"] as const).map((name) => (
        <Check key={name} label={t(name)} checked={wanted[name]} onChange={(checked) => setWanted({ ...wanted, [name]: checked })} />
      ))}
      <button type="button" class="primary" data-testid="save-figure" disabled={busy} onClick={() => void save()}>
        {busy ? t("drawing") : t("save")}
      </button>
      {problem && <ProblemBox problem={problem} />}
    </>
  );
}
