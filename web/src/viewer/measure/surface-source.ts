/** The surface of a cloud, read once when it is first asked for. */
import { fetched } from "../../api/client";
import { SurfaceGraph } from "./geodesic";
import { readPly, type Surface } from "./ply";

const surfaces = new Map<string, Promise<Surface>>();
const graphs = new Map<string, Promise<SurfaceGraph>>();

export function surfaceOf(cloudId: string): Promise<Surface> {
  return once(surfaces, cloudId, async () =>
    readPly(await (await fetched(`/v1/clouds/${cloudId}/exports/mesh-ply/content`)).arrayBuffer()),
  );
}

export function surfaceGraph(cloudId: string): Promise<SurfaceGraph> {
  return once(graphs, cloudId, async () => new SurfaceGraph(await surfaceOf(cloudId)));
}

function once<T>(kept: Map<string, Promise<T>>, key: string, make: () => Promise<T>): Promise<T> {
  let value = kept.get(key);
  if (!value) {
    // One cloud is looked at at a time.
    kept.clear();
    value = make();
    value.catch(() => kept.delete(key));
    kept.set(key, value);
  }
  return value;
}
