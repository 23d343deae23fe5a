/** Which label layer lies over the colours, its legend and opacity. */
import { useEffect } from "preact/hooks";
import { unsavedNames } from "../labels/unsaved";
import { t } from "../texts";
import type { PanelProps } from "../viewer";
import { Choice, Slider } from "./fields";

export function LayerChoice({ model }: PanelProps) {
  const { layer, opacity } = model.state.value;
  const shown = model.layers.shown.value;
  useEffect(() => void model.layers.refresh(), [model]);
  const stored = model.layers.list.value.map(({ name }) => name);
  const names = new Set([...stored, ...unsavedNames(model.info.id), ...(layer === null ? [] : [layer])]);
  if (names.size === 0) return null;
  return (
    <>
      <Choice
        label={t("layer")}
        testid="layer"
        value={layer ?? ""}
        options={[["", t("noLayer")], ...[...names].map((name) => [name, name] as const)]}
        onChange={(name) => model.patch({ layer: name === "" ? null : name })}
      />
      {layer !== null && (
        <>
          <Slider
            label={t("opacity")}
            testid="opacity"
            min={0}
            max={1}
            step={0.05}
            value={opacity}
            onInput={(value) => model.patch({ opacity: value })}
          />
          <ul class="legend" data-testid="legend">
            {shown?.classes.map(({ name, colour }) => (
              <li>
                <span class="swatch" style={{ backgroundColor: colour ?? "transparent" }} aria-hidden="true" />
                {name}
              </li>
            ))}
          </ul>
        </>
      )}
    </>
  );
}
