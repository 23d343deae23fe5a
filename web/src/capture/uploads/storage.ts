/** What must outlive a reload: files on their way with their bytes, and small pictures of photos. In IndexedDB. */
import type { Item } from "./item";

const NAME = "specimap.capture";
const ITEMS = "items";
const BYTES = "bytes";
const PICTURES = "pictures";
/** A file that takes more than this share of the browser's free room stays where it is. */
const LARGEST_SHARE = 0.4;
const SURELY_KEPT = 4_000_000;
const LARGEST_KEPT = 1_500_000_000;

let opened: Promise<IDBDatabase> | null = null;

function database(): Promise<IDBDatabase> {
  opened ??= new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => {
      for (const store of [ITEMS, BYTES, PICTURES]) request.result.createObjectStore(store);
    };
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error ?? new Error("IndexedDB"));
  });
  opened.catch(() => (opened = null));
  return opened;
}

async function within<T>(
  stores: string[],
  mode: IDBTransactionMode,
  work: (transaction: IDBTransaction) => IDBRequest<T> | undefined,
): Promise<T | undefined> {
  const transaction = (await database()).transaction(stores, mode);
  return await new Promise((resolve, reject) => {
    const request = work(transaction);
    transaction.oncomplete = () => resolve(request?.result);
    transaction.onabort = () => reject(transaction.error ?? new Error("IndexedDB"));
    transaction.onerror = () => reject(transaction.error ?? new Error("IndexedDB"));
  });
}

/** Whether a file of this size fits into what the browser keeps. */
export async function fits(size: number): Promise<boolean> {
  if (size > LARGEST_KEPT) return false;
  // Asking how much room there is takes longer than keeping a photo.
  if (size < SURELY_KEPT) return true;
  // On plain HTTP browsers do not say how much there is room for.
  if (!("storage" in navigator)) return true;
  const { quota, usage } = await navigator.storage.estimate().catch(() => ({ quota: undefined, usage: undefined }));
  return quota === undefined || size < LARGEST_SHARE * (quota - (usage ?? 0));
}

/** Ask the browser not to clear what is kept when its disk runs short. */
export async function keepForGood(): Promise<void> {
  if ("storage" in navigator) await navigator.storage.persist().catch(() => false);
}

/** Keep an item, and its bytes with it where they are given. Rejects where the browser keeps nothing. */
export async function keep(item: Item, bytes?: Blob): Promise<void> {
  await within([ITEMS, BYTES], "readwrite", (transaction) => {
    transaction.objectStore(ITEMS).put(item, item.id);
    if (bytes) transaction.objectStore(BYTES).put(bytes, item.id);
    return undefined;
  });
}

/** Forget an item and its bytes. */
export async function forget(id: string): Promise<void> {
  await within([ITEMS, BYTES], "readwrite", (transaction) => {
    transaction.objectStore(ITEMS).delete(id);
    transaction.objectStore(BYTES).delete(id);
    return undefined;
  });
}

/** All items that are kept. */
export async function kept(): Promise<Item[]> {
  return (await within<Item[]>([ITEMS], "readonly", (t) => t.objectStore(ITEMS).getAll() as IDBRequest<Item[]>)) ?? [];
}

/** The bytes of an item, where they are kept. */
export async function bytesOf(id: string): Promise<Blob | undefined> {
  return await within<Blob>([BYTES], "readonly", (t) => t.objectStore(BYTES).get(id) as IDBRequest<Blob>);
}

/** Keep a small picture, by the id of its item or of the service's file. */
export async function keepPicture(id: string, picture: Blob): Promise<void> {
  await within([PICTURES], "readwrite", (transaction) => {
    transaction.objectStore(PICTURES).put(picture, id);
    return undefined;
  });
}

/** A small picture, where there is one. */
export async function pictureOf(id: string): Promise<Blob | undefined> {
  return await within<Blob>([PICTURES], "readonly", (t) => t.objectStore(PICTURES).get(id) as IDBRequest<Blob>);
}
