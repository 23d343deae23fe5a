/** From where, and how large, the points are seen. */
import { ProblemBox } from "../../ui/boxes";
import { t } from "../texts";
import type { PanelProps } from "../viewer";
import { SHAPES } from "../view-state";
import { Choice, Slider } from "./fields";

const SIDES = [
  ["fromAll", [0, -0.55, 1]],
  ["fromTop", [0, -0.001, 1]],
  ["fromFront", [0, -1, 0.12]],
  ["fromSide", [1, 0, 0.12]],
] as const;

export function ViewPanel({ model }: PanelProps) {
  const { size, shape } = model.state.value;
  const problem = model.meshProblem.value;
  const look = (from: readonly [number, number, number]): void => {
    const view = model.view.value;
    view?.home(from);
    view?.onRest();
  };
  return (
    <>
      <div class="row" role="group" aria-label={t("viewFrom")}>
        {SIDES.map(([key, from]) => (
          <button type="button" data-testid={`view-${key}`} onClick={() => look(from)}>
            {t(key)}
          </button>
        ))}
      </div>
      <Choice
        label={t("shape")}
        testid="shape"
        value={shape}
        options={SHAPES.map((name) => [name, t(name)] as const)}
        onChange={(name) => model.patch({ shape: name })}
      />
      {problem && <ProblemBox problem={problem} again={() => model.patch({})} />}
      <Slider
        label={t("pointSize")}
        testid="point-size"
        min={0.5}
        max={3}
        step={0.1}
        value={size}
        onInput={(value) => model.patch({ size: value })}
      />
    </>
  );
}
