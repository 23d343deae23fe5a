/** Reads a cloud's arrays apart from the page, so that decoding never holds up a picture. */
import { get, open, registry, root, slice, withConsolidatedMetadata, type Array as ZarrArray, type DataType } from "zarrita";
import { bloscCodec } from "./blosc";
import { Refusal, ShardStore } from "./shard-store";
import { shardsFromMiddle, type Span } from "./shard-plan";

/** What the page asks of the reader. */
export type Ask =
  | { kind: "open"; url: string }
  | { kind: "array"; id: number; name: string }
  | { kind: "spectra"; id: number; spans: Span[] }
  | { kind: "stop"; id: number };

export type Values = Float32Array<ArrayBuffer> | Uint8Array<ArrayBuffer> | Uint16Array<ArrayBuffer>;

/** What the reader answers. Parts of arrays come as they are decoded. */
export type Tell =
  | { kind: "opened"; attributes: Record<string, unknown>; points: number; bands: number; decode: Decode }
  | { kind: "part"; name: string; start: number; values: Values; id?: number }
  | { kind: "done"; id?: number }
  | { kind: "waiting"; seconds: number }
  | { kind: "failed"; id?: number; status: number; text: string };

/** stored * scale + offset; `fill` stands for no value. */
export interface Decode {
  scale: number;
  offset: number;
  fill: number | null;
}

registry.set("blosc", () => Promise.resolve(bloscCodec));

const tell = (message: Tell, moved: Transferable[] = []): void => postMessage(message, { transfer: moved });
const stopped = new Set<number>();
const ended = new AbortController();
let cloud: Promise<Opened> | null = null;

interface Opened {
  array: (name: string) => Promise<ZarrArray<DataType, ShardStore>>;
  store: ShardStore;
}

onmessage = ({ data }: MessageEvent<Ask>): void => {
  if (data.kind === "stop") {
    stopped.add(data.id);
    return;
  }
  const id = data.kind === "open" ? undefined : data.id;
  const work = data.kind === "open" ? openCloud(data.url) : data.kind === "array" ? readArray(data) : readSpectra(data);
  work.then(
    () => tell(id === undefined ? { kind: "done" } : { kind: "done", id }),
    (error: unknown) => {
      const refusal = error instanceof Refusal ? error : new Refusal(0, error instanceof Error ? error.message : "");
      tell({ kind: "failed", ...(id === undefined ? {} : { id }), status: refusal.status, text: refusal.text });
    },
  );
};

/** Tell what the cloud is, then its outline, colours and positions, the middle of the picture first. */
async function openCloud(url: string): Promise<void> {
  const patience = { signal: ended.signal, waiting: (seconds: number) => tell({ kind: "waiting", seconds }) };
  const store = new ShardStore(url, patience, (key) => !key.startsWith("/spectra/"));
  cloud = (async () => {
    const group = await open.v3(root(await withConsolidatedMetadata(store, { format: "v3" })), { kind: "group" });
    const spectra = await open.v3(group.resolve("spectra"), { kind: "array" });
    const attrs = spectra.attrs as { scale_factor?: number; add_offset?: number; _FillValue?: number };
    const decode = { scale: attrs.scale_factor ?? 1, offset: attrs.add_offset ?? 0, fill: attrs._FillValue ?? null };
    const [points = 0, bands = 0] = spectra.shape;
    tell({ kind: "opened", attributes: group.attrs, points, bands, decode });
    return {
      store,
      array: async (name: string) => (await open.v3(group.resolve(name), { kind: "array" })) as never,
    };
  })();
  const opened = await cloud;
  const outline = await opened.array("chunk_aabb");
  tell({ kind: "part", name: "chunk_aabb", start: 0, values: await valuesOf(outline, 0, outline.shape[0] ?? 0) });
  const [rgb, xyz] = await Promise.all([opened.array("rgb"), opened.array("xyz")]);
  // Colours first: they are a quarter of the bytes, and the coarse picture is drawn with them.
  await shards(rgb, "rgb", store);
  await shards(xyz, "xyz", store);
}

async function readArray({ id, name }: { id: number; name: string }): Promise<void> {
  const opened = await known();
  await shards(await opened.array(name), name, opened.store, id);
}

/** Read stored spectra of spans of points. */
async function readSpectra({ id, spans }: { id: number; spans: Span[] }): Promise<void> {
  const array = await (await known()).array("spectra");
  await inTurns(spans, 3, async ({ start, stop }) => {
    if (stopped.has(id)) return;
    const values = await valuesOf(array, start, stop);
    tell({ kind: "part", name: "spectra", id, start, values }, [values.buffer]);
  });
  stopped.delete(id);
}

async function shards(array: ZarrArray<DataType, ShardStore>, name: string, store: ShardStore, id?: number): Promise<void> {
  const points = array.shape[0] ?? 0;
  const shard = shardLength(array, points);
  await inTurns(shardsFromMiddle(points, shard), 3, async ({ start, stop }) => {
    const values = await valuesOf(array, start, stop);
    const number = Math.floor(start / shard);
    store.drop(`/${name}/c/${number}${array.shape.length > 1 ? "/0" : ""}`);
    tell({ kind: "part", name, start, values, ...(id === undefined ? {} : { id }) }, [values.buffer]);
  });
}

/** `chunks` of a sharded array are its inner chunks: 32 of 4096 points are a shard. */
function shardLength(array: ZarrArray<DataType, ShardStore>, points: number): number {
  const inner = array.chunks[0] ?? points;
  return inner * Math.max(1, Math.round(131072 / inner));
}

async function valuesOf(array: ZarrArray<DataType, ShardStore>, start: number, stop: number): Promise<Values> {
  const rest = array.shape.slice(1).map(() => null);
  const { data } = await get(array, [slice(start, stop), ...rest]);
  return data as Values;
}

async function inTurns<T>(items: readonly T[], together: number, work: (item: T) => Promise<void>): Promise<void> {
  const waiting = [...items];
  const one = async (): Promise<void> => {
    for (let item = waiting.shift(); item !== undefined; item = waiting.shift()) await work(item);
  };
  await Promise.all(Array.from({ length: together }, one));
}

async function known(): Promise<Opened> {
  if (!cloud) throw new Error("no cloud is open");
  return cloud;
}
