import { useEffect, useMemo } from "preact/hooks";
import { Group } from "three";
import type { ViewerModel } from "../viewer-model";
import { emptied } from "./lines";

/** A group of what a panel draws in the view, there while the panel is open. */
export function useGroup(model: ViewerModel): Group {
  const group = useMemo(() => new Group(), []);
  const view = model.view.value;
  useEffect(() => {
    if (!view) return;
    view.extras.add(group);
    return () => {
      view.extras.remove(emptied(group));
      view.draw();
    };
  }, [view, group]);
  return group;
}
