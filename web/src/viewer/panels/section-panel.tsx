/** A plane that cuts the cloud. */
import { number } from "../../i18n";
import { t } from "../texts";
import type { Axis } from "../view-state";
import type { PanelProps } from "../viewer";
import { Check, Choice, Slider } from "./fields";

const AXES: readonly Axis[] = ["x", "y", "z"];

export function SectionPanel({ model }: PanelProps) {
  const { section } = model.state.value;
  const { low, high } = model.info;
  const middle = (axis: Axis): number => {
    const i = AXES.indexOf(axis);
    return Math.round((((low[i] ?? 0) + (high[i] ?? 0)) / 2) * 10) / 10;
  };
  const i = section ? AXES.indexOf(section.axis) : 0;
  return (
    <>
      <Choice
        label={t("section")}
        testid="section-axis"
        value={section?.axis ?? ""}
        options={[["", t("sectionOff")], ...AXES.map((axis) => [axis, t("sectionAlong", { axis })] as const)]}
        onChange={(axis) => model.patch({ section: axis === "" ? null : { axis, at: middle(axis), flip: section?.flip ?? false } })}
      />
      {section && (
        <>
          <Slider
            label={`${t("sectionAt")}: ${number(section.at, 1)}`}
            testid="section-at"
            min={Math.floor(low[i] ?? 0)}
            max={Math.ceil(high[i] ?? 0)}
            step={0.1}
            value={section.at}
            text={`${number(section.at, 1)} mm`}
            onInput={(at) => model.patch({ section: { ...section, at } })}
          />
          <Check
            label={t("flip")}
            testid="section-flip"
            checked={section.flip}
            onChange={(flip) => model.patch({ section: { ...section, flip } })}
          />
        </>
      )}
    </>
  );
}
