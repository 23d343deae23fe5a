/** The viewer's frame: the picture, and the panels beside or below it. */
import type { ComponentChildren, ComponentType } from "preact";
import { useEffect, useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { may, session } from "../app/session";
import { Loading, ProblemBox } from "../ui/boxes";
import { Canvas } from "./canvas";
import { ColourPanel } from "./panels/colour-panel";
import { SectionPanel } from "./panels/section-panel";
import { ViewPanel } from "./panels/view-panel";
import { VerdictLamp } from "./panels/verdict";
import { OutlineOverlay } from "./select/lasso-tool";
import { t, type ViewerKey } from "./texts";
import type { ViewerModel } from "./viewer-model";

export interface PanelProps {
  model: ViewerModel;
}
type Panel = ComponentType<PanelProps>;

interface LazyPanel {
  name: ViewerKey;
  load: () => Promise<{ default: Panel }>;
  /** Whether the session may use it. */
  allowed?: () => boolean;
}

const own = (): boolean => session.value?.cloud_id == null;

/** Parts that are loaded when they are first opened. */
const PANELS: LazyPanel[] = [
  { name: "labels", load: () => import("./labels/label-panel"), allowed: () => own() && may("label.write") },
  { name: "measure", load: () => import("./measure/measure-panel") },
  { name: "cameras", load: () => import("./cameras/camera-panel") },
  { name: "top", load: () => import("./top/top-panel") },
  { name: "figure", load: () => import("./figure/figure-panel") },
  { name: "share", load: () => import("./share/share-panel"), allowed: () => own() && may("share.manage") && may("result.read") },
  { name: "quality", load: () => import("./panels/quality-panel") },
];

export function Viewer({ model, fallback }: { model: ViewerModel; fallback: ComponentChildren }) {
  const [broken, setBroken] = useState(false);
  if (broken) return <>{fallback}</>;
  return (
    <div class="viewer">
      <h1 class="unseen">{t("picture")}</h1>
      <div class="stage">
        <Canvas model={model} onBroken={() => setBroken(true)} />
        <OutlineOverlay />
        <Trouble model={model} />
      </div>
      <aside class="panels" aria-label={t("show")}>
        {!own() && <p class="small">{t("readOnly")}</p>}
        <VerdictLamp model={model} />
        <Fold name="colour" open>
          <ColourPanel model={model} />
        </Fold>
        <LazyFold panel={{ name: "spectrum", load: () => import("./spectra/spectrum-panel") }} model={model} open />
        <Fold name="picture">
          <ViewPanel model={model} />
        </Fold>
        <Fold name="section">
          <SectionPanel model={model} />
        </Fold>
        {PANELS.filter(({ allowed }) => allowed?.() ?? true).map((panel) => (
          <LazyFold key={panel.name} panel={panel} model={model} />
        ))}
      </aside>
    </div>
  );
}

/** The service's silence, while the picture stays. */
function Trouble({ model }: PanelProps) {
  const seconds = model.loader.waiting.value;
  const problem = model.colouring.value?.problem.value ?? model.layers.problem.value;
  return (
    <div class="trouble" role="status">
      {seconds > 0 && <p class="box warning">{t("waiting", { n: Math.ceil(seconds) })}</p>}
      {problem && <ProblemBox problem={problem} again={() => void model.paint()} />}
    </div>
  );
}

function Fold({ name, open = false, children, onOpen }: { name: ViewerKey; open?: boolean; children: ComponentChildren; onOpen?: () => void }) {
  return (
    <details open={open} data-testid={`panel-${name}`} onToggle={(event) => event.currentTarget.open && onOpen?.()}>
      <summary>{t(name)}</summary>
      <div class="fold">{children}</div>
    </details>
  );
}

function LazyFold({ panel, model, open = false }: { panel: LazyPanel; model: ViewerModel; open?: boolean }) {
  const [wanted, setWanted] = useState(open);
  const [loaded, setLoaded] = useState<{ show: Panel } | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const { load } = panel;
  // The picture comes first.
  const waits = model.loader.state.value === "loading";
  useEffect(() => {
    if (!wanted || waits || loaded || problem) return;
    load().then(
      (module) => setLoaded({ show: module.default }),
      (thrown: unknown) => setProblem(asProblem(thrown)),
    );
  }, [wanted, waits, loaded, problem, load]);
  return (
    <Fold name={panel.name} open={open} onOpen={() => setWanted(true)}>
      {problem ? (
        <ProblemBox problem={problem} again={() => setProblem(null)} />
      ) : loaded ? (
        <loaded.show model={model} />
      ) : (
        wanted && <Loading />
      )}
    </Fold>
  );
}
