/** A stroke around a region of the picture, as a tool of the canvas. */
import { signal } from "@preact/signals";
import { useEffect, useMemo, useRef } from "preact/hooks";
import type { Tool, ViewerModel } from "../viewer-model";
import { pointsInOutline, thinned, type Outline } from "./lasso";

/** What is being drawn, in CSS pixels of the canvas; the page shows it over the picture. */
export const drawnOutline = signal<Outline>([]);

/** Make a lasso. `done` takes the points that are seen within. */
export function lassoTool(model: ViewerModel, name: string, done: (indices: number[]) => void): Tool {
  return {
    name,
    down: (x, y) => {
      drawnOutline.value = [[x, y]];
      return true;
    },
    move: (x, y) => {
      if (drawnOutline.peek().length > 0) drawnOutline.value = thinned([...drawnOutline.peek(), [x, y]]);
    },
    up: () => {
      const outline = drawnOutline.peek();
      drawnOutline.value = [];
      const view = model.view.value;
      const indices = view ? pointsInOutline(view.cloud, view.projection(), outline, view.shownHalf) : [];
      if (indices.length > 0) done(indices);
    },
  };
}

/** A lasso that is switched on, used once, and off again. */
export function useLasso(model: ViewerModel, done: (indices: number[]) => void): { on: boolean; toggle: () => void } {
  const name = "lasso-spectra";
  const latest = useRef(done);
  latest.current = done;
  const tool = useMemo(
    () =>
      lassoTool(model, name, (indices) => {
        model.tool.value = null;
        latest.current(indices);
      }),
    [model],
  );
  useEffect(() => () => {
    if (model.tool.peek()?.name === name) model.tool.value = null;
  }, [model]);
  const on = model.tool.value?.name === name;
  return { on, toggle: () => (model.tool.value = on ? null : tool) };
}

export function OutlineOverlay() {
  const outline = drawnOutline.value;
  if (outline.length < 2) return null;
  return (
    <svg class="stage-overlay" aria-hidden="true">
      <polygon class="outline" points={outline.map((at) => at.join(",")).join(" ")} />
    </svg>
  );
}
