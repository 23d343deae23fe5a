/** What the service knows of an acquisition: asked for now and then, and at once when a file of ours was judged. */
import { useEffect, useRef, useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import type { Problem } from "../api/problem";
import type { File } from "./photos/checks";
import { onArrival } from "./uploads/queue";

export type Acquisition = Schemas["Acquisition"];

export interface AcquisitionData {
  acquisition: Acquisition | undefined;
  files: readonly File[];
  problem: Problem | null;
  refresh: () => void;
}

/** Seconds between questions, for what other devices add. */
const PAUSE = 5;

export function useAcquisition(acquisition_id: string): AcquisitionData {
  const asked = usePolled(
    `capture:${acquisition_id}`,
    async (signal) => {
      const params = { path: { acquisition_id } };
      const [acquisition, files] = await Promise.all([
        body(api.GET("/v1/acquisitions/{acquisition_id}", { params, signal })),
        body(api.GET("/v1/acquisitions/{acquisition_id}/files", { params, signal })),
      ]);
      return { acquisition, files };
    },
    PAUSE,
  );
  // Judgements come with the upload's answer: they are shown before the next answer lists them.
  const [arrived, setArrived] = useState<readonly File[]>([]);
  const again = useRef(asked.again);
  again.current = asked.again;
  useEffect(
    () =>
      onArrival((item, file) => {
        if (item.acquisition !== acquisition_id) return;
        setArrived((before) => [...before, file]);
        again.current();
      }),
    [acquisition_id],
  );
  useEffect(() => setArrived([]), [asked.data]);
  const listed = asked.data?.files ?? [];
  const known = new Set(listed.map(({ id }) => id));
  return {
    acquisition: asked.data?.acquisition,
    files: [...listed, ...arrived.filter(({ id }) => !known.has(id))],
    problem: asked.problem,
    refresh: asked.again,
  };
}

/** Delete a file of the service. Throws a Problem. */
export async function deleteFile(acquisition_id: string, file_id: string): Promise<void> {
  await api.DELETE("/v1/acquisitions/{acquisition_id}/files/{file_id}", { params: { path: { acquisition_id, file_id } } });
}
