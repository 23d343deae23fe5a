/** The dome as the service measures it, asked for anew whenever the photos change. */
import { useEffect, useRef } from "preact/hooks";
import { api, body } from "../../api/client";
import { usePolled } from "../../api/polling";
import type { Photo } from "../photos/checks";
import type { Viewpoints } from "./geometry";

export function useViewpoints(acquisition_id: string, photos: readonly Photo[]): Viewpoints | undefined {
  const asked = usePolled(`viewpoints:${acquisition_id}`, async (signal) =>
    body(api.GET("/v1/acquisitions/{acquisition_id}/viewpoints", { params: { path: { acquisition_id } }, signal })),
  );
  const again = useRef(asked.again);
  again.current = asked.again;
  const now = photos.map(({ id }) => id).join();
  const before = useRef(now);
  useEffect(() => {
    if (before.current === now) return;
    before.current = now;
    again.current();
  }, [now]);
  return asked.data;
}
