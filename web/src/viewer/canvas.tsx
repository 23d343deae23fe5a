/** The canvas: sets the view up, and turns taps, strokes and keys into what the tools do. */
import { useEffect, useRef } from "preact/hooks";
import { number } from "../i18n";
import { CloudView } from "./render/cloud-view";
import { t } from "./texts";
import type { ViewerModel } from "./viewer-model";

const TAP_PX = 6;
const TAP_MS = 600;
const TURN = Math.PI / 24;

declare global {
  interface Window {
    /** For tests: where a point of the cloud lies on the page, CSS pixels; null before the cloud is there. */
    specimapViewer?: { project: (index: number) => { x: number; y: number } | null };
  }
}

export function Canvas({ model, onBroken }: { model: ViewerModel; onBroken: () => void }) {
  const ref = useRef<HTMLCanvasElement>(null);
  const cloud = model.cloud.value;
  const loadState = model.loader.state.value;
  const hasOutline = loadState !== "loading";
  const broken = useRef(onBroken);
  broken.current = onBroken;

  useEffect(() => {
    const canvas = ref.current;
    if (!canvas || !cloud || !hasOutline) return;
    let view: CloudView;
    try {
      view = new CloudView(canvas, cloud);
    } catch {
      broken.current();
      return;
    }
    model.attach(view);
    view.onFrame = () => (canvas.dataset.drawn = String(Number(canvas.dataset.drawn ?? 0) + 1));
    window.specimapViewer = {
      project: (index) => {
        const at = view.project(index);
        const box = canvas.getBoundingClientRect();
        return at && { x: at.x + box.left, y: at.y + box.top };
      },
    };
    return () => {
      delete window.specimapViewer;
    };
  }, [model, cloud, hasOutline]);

  useBackground(model);
  const strokes = useStrokes(model);
  const { mode, shape } = model.state.value;
  const [x = 0, y = 0, z = 0] = model.info.low.map((low, i) => (model.info.high[i] ?? 0) - low);
  const text = t("pictureText", { n: model.info.points, x: number(x), y: number(y), z: number(z), mode: t(mode) });
  return (
    <div class="canvas-box" {...strokes}>
      <canvas
        ref={ref}
        tabIndex={0}
        role="application"
        aria-label={t("picture")}
        aria-describedby="picture-help picture-text"
        data-testid="viewer-canvas"
        data-state={loadState}
        data-points={cloud ? cloud.points : 0}
        data-shape={shape}
        onKeyDown={(event) => onKey(event, model)}
      />
      <p id="picture-help" class="unseen">
        {t("pictureHelp")}
      </p>
      <p id="picture-text" class="unseen">
        {text}
      </p>
    </div>
  );
}

/** Behind the cloud lies the page's own colour, light or dark. */
function useBackground(model: ViewerModel): void {
  const view = model.view.value;
  useEffect(() => {
    if (!view) return;
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const set = (): void => view.setBackground(dark.matches ? "#0b0e11" : "#e9ecef");
    set();
    dark.addEventListener("change", set);
    return () => dark.removeEventListener("change", set);
  }, [view]);
}

/** Handlers that come before the camera's own: a tool may keep a stroke for itself. */
function useStrokes(model: ViewerModel) {
  const began = useRef<{ x: number; y: number; at: number; kept: boolean; pointer: number } | null>(null);
  const hover = useRef(0);
  const place = (event: PointerEvent): [number, number] => {
    const box = model.view.value?.canvas.getBoundingClientRect();
    return [event.clientX - (box?.left ?? 0), event.clientY - (box?.top ?? 0)];
  };
  return {
    onPointerDownCapture: (event: PointerEvent) => {
      const view = model.view.value;
      if (!view || event.target !== view.canvas) return;
      const [x, y] = place(event);
      if (began.current && began.current.pointer !== event.pointerId) {
        // A second finger: this is no tap.
        began.current.at = -Infinity;
        return;
      }
      const kept = event.button === 0 && (model.tool.value?.down?.(x, y, event) ?? false);
      view.controls.enabled = !kept;
      if (kept) view.canvas.setPointerCapture(event.pointerId);
      began.current = { x, y, at: performance.now(), kept, pointer: event.pointerId };
    },
    onPointerMoveCapture: (event: PointerEvent) => {
      const [x, y] = place(event);
      if (began.current?.kept) model.tool.value?.move?.(x, y, event);
      else if (!began.current && event.pointerType === "mouse") {
        cancelAnimationFrame(hover.current);
        hover.current = requestAnimationFrame(() => {
          model.tool.value?.move?.(x, y, event);
          model.cursor.value = model.pointAt(x, y);
        });
      }
    },
    onPointerUpCapture: (event: PointerEvent) => {
      const stroke = began.current;
      const view = model.view.value;
      if (!stroke || !view || stroke.pointer !== event.pointerId) return;
      began.current = null;
      const [x, y] = place(event);
      const tool = model.tool.value;
      if (stroke.kept) tool?.up?.(x, y, event);
      view.controls.enabled = true;
      const still = Math.hypot(x - stroke.x, y - stroke.y) < TAP_PX && performance.now() - stroke.at < TAP_MS;
      if (!still || stroke.kept || event.button !== 0) return;
      tapAt(model, x, y, event);
    },
    onPointerCancelCapture: () => {
      began.current = null;
      if (model.view.value) model.view.value.controls.enabled = true;
    },
    onPointerLeave: () => {
      cancelAnimationFrame(hover.current);
      if (!began.current) model.cursor.value = null;
    },
  };
}

function tapAt(model: ViewerModel, x: number, y: number, event: PointerEvent | KeyboardEvent): void {
  if (model.tapFirst?.(x, y)) return;
  const index = model.pointAt(x, y);
  if (index === null) return;
  const { tap } = model.tool.value ?? {};
  if (tap && event instanceof PointerEvent) tap(index, event);
  else void model.choose(index, event.shiftKey || model.keep.value);
}

function onKey(event: KeyboardEvent, model: ViewerModel): void {
  const view = model.view.value;
  if (!view || event.ctrlKey || event.metaKey || event.altKey) return;
  const turns: Record<string, () => void> = {
    ArrowLeft: () => view.orbit(-TURN, 0),
    ArrowRight: () => view.orbit(TURN, 0),
    ArrowUp: () => view.orbit(0, TURN),
    ArrowDown: () => view.orbit(0, -TURN),
    "+": () => view.orbit(0, 0, 1.15),
    "=": () => view.orbit(0, 0, 1.15),
    "-": () => view.orbit(0, 0, 1 / 1.15),
    Home: () => view.home(),
    Enter: () => tapAt(model, view.canvas.clientWidth / 2, view.canvas.clientHeight / 2, event),
  };
  const act = turns[event.key];
  if (!act) return;
  event.preventDefault();
  act();
}
