/** Painting labels: layer, class, tool, undo, save. */
import { useEffect, useId, useLayoutEffect, useMemo, useState } from "preact/hooks";
import { ProblemBox } from "../../ui/boxes";
import { fieldText } from "../../ui/form";
import { distinct } from "../colour/colour-maps";
import { Choice, NumberField, Slider } from "../panels/fields";
import type { PanelProps } from "../viewer";
import { Painter, type ToolName } from "./painter";
import { t } from "./texts";

const NAME = "[a-z0-9_\\-]{1,64}";

export default function LabelPanel({ model }: PanelProps) {
  const painter = useMemo(() => new Painter(model), [model]);
  const layer = model.layers.shown.value;
  // Before anybody can paint.
  useLayoutEffect(() => painter.take(), [painter, layer]);
  useEffect(() => () => painter.close(), [painter]);
  // Closing the window loses what is not saved: the browser asks.
  const dirty = painter.dirty.value;
  useEffect(() => {
    if (!dirty) return;
    const ask = (event: BeforeUnloadEvent): void => event.preventDefault();
    addEventListener("beforeunload", ask);
    return () => removeEventListener("beforeunload", ask);
  }, [dirty]);

  if (!layer) {
    return (
      <>
        <p class="small">{t("shownFirst")}</p>
        <NewLayer onBegin={(name) => painter.begin(name)} />
      </>
    );
  }
  if (layer.kind !== "class") {
    const name = `${layer.name}-painted`.slice(0, 64);
    return (
      <>
        <p class="small">{t("probability", { name })}</p>
        <button type="button" onClick={() => painter.begin(name, layer)}>
          {t("begin")}
        </button>
      </>
    );
  }
  return (
    <div data-testid="painter" data-dirty={String(dirty)} data-layer={layer.name}>
      <ClassChoice model={model} painter={painter} />
      <Tools painter={painter} />
      <SaveRow painter={painter} />
    </div>
  );
}

function NewLayer({ onBegin }: { onBegin: (name: string) => void }) {
  const id = useId();
  return (
    <form
      onSubmit={(event) => {
        event.preventDefault();
        onBegin(fieldText(event.currentTarget, "layer"));
      }}
    >
      <label for={id}>{t("name")}</label>
      <input id={id} name="layer" type="text" required pattern={NAME} maxLength={64} aria-describedby={`${id}-hint`} data-testid="new-layer" />
      <p class="small" id={`${id}-hint`}>
        {t("nameHint")}
      </p>
      <button type="submit" data-testid="begin-layer">
        {t("begin")}
      </button>
    </form>
  );
}

function ClassChoice({ model, painter }: PanelProps & { painter: Painter }) {
  const [adding, setAdding] = useState(false);
  const classes = model.layers.shown.value?.classes ?? [];
  return (
    <>
      <Choice
        label={t("cls")}
        testid="paint-class"
        value={String(painter.cls.value)}
        options={classes.map(({ value, name }) => [String(value), name] as const)}
        onChange={(value) => (painter.cls.value = Number(value))}
      />
      {adding ? (
        <form
          onSubmit={(event) => {
            event.preventDefault();
            painter.addClass(fieldText(event.currentTarget, "name"), fieldText(event.currentTarget, "colour"));
            setAdding(false);
          }}
        >
          <label>
            {t("className")}
            <input name="name" type="text" required maxLength={100} />
          </label>
          <label>
            {t("colour")}
            <input name="colour" type="color" value={distinct(classes.length)} />
          </label>
          <button type="submit">{t("add")}</button>
        </form>
      ) : (
        <button type="button" onClick={() => setAdding(true)}>
          {t("add")}
        </button>
      )}
    </>
  );
}

function Tools({ painter }: { painter: Painter }) {
  const tool = painter.tool.value;
  const names: readonly ToolName[] = ["off", "brush", "lasso", "similar"];
  return (
    <>
      <Choice
        label={t("tool")}
        testid="paint-tool"
        value={tool}
        options={names.map((name) => [name, t(name)] as const)}
        onChange={(name) => painter.choose(name)}
      />
      {tool === "brush" && (
        <>
          <NumberField
            label={t("radius")}
            testid="brush-radius"
            min={0.05}
            max={20}
            step={0.1}
            value={painter.radius.value}
            onChange={(value) => (painter.radius.value = value)}
          />
          <p class="small">{t("brushHint")}</p>
        </>
      )}
      {tool === "similar" && (
        <>
          <Slider
            label={`${t("angle")}: ${painter.degrees.value}`}
            testid="similar-angle"
            min={0.5}
            max={30}
            step={0.5}
            value={painter.degrees.value}
            onInput={(value) => (painter.degrees.value = value)}
          />
          <NumberField
            label={t("reach")}
            testid="similar-reach"
            min={0.5}
            max={500}
            step={0.5}
            value={painter.reach.value}
            onChange={(value) => (painter.reach.value = value)}
          />
          <p class="small">{t("similarHint")}</p>
        </>
      )}
      <p class="small" role="status" data-testid="paint-status">
        {painter.busy.value ? t("seeking") : painter.gave.value !== null ? t("gave", { n: painter.gave.value }) : ""}
      </p>
    </>
  );
}

function SaveRow({ painter }: { painter: Painter }) {
  // The history is no signal: it changes with this count.
  const changes = painter.changes.value;
  const { saved, problem } = painter;
  return (
    <div data-changes={changes}>
      <div class="row">
        <button type="button" data-testid="undo" disabled={!painter.history?.canUndo} onClick={() => painter.undo()}>
          {t("undo")}
        </button>
        <button type="button" data-testid="redo" disabled={!painter.history?.canRedo} onClick={() => painter.redo()}>
          {t("redo")}
        </button>
        <button
          type="button"
          class="primary"
          data-testid="save-labels"
          disabled={painter.busy.value || !painter.dirty.value}
          onClick={() => void painter.save()}
        >
          {t("save")}
        </button>
      </div>
      <p class="small" role="status" data-testid="save-status">
        {saved.value !== null ? t("saved", { version: saved.value }) : painter.dirty.value ? t("unsaved") : ""}
      </p>
      {painter.conflict.value && (
        <div class="box warning" role="alert" data-testid="label-conflict">
          <p>{t("changed")}</p>
          <div class="row">
            <button type="button" onClick={() => void painter.takeTheirs()}>
              {t("takeTheirs")}
            </button>
            <button type="button" data-testid="keep-mine" onClick={() => void painter.keepMine()}>
              {t("keepMine")}
            </button>
          </div>
        </div>
      )}
      {problem.value && <ProblemBox problem={problem.value} />}
    </div>
  );
}
