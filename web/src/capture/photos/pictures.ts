/** Small pictures of photos, made here: the service keeps originals only. */
import { signal } from "@preact/signals";
import { bytesOf, keepPicture, pictureOf } from "../uploads/storage";

const WIDTH = 320;

/** Addresses of pictures by the id of an item or of a file; null where there is none. */
const addresses = signal<ReadonlyMap<string, string | null>>(new Map());

/** Files of the service by the items that they were: a photo may be judged before its picture is drawn. */
const became = new Map<string, string>();

function show(id: string, picture: Blob | undefined): void {
  const address = picture ? URL.createObjectURL(picture) : null;
  addresses.value = new Map(addresses.value).set(id, address).set(became.get(id) ?? id, address);
}

/** Make and keep the picture of a photo; without one where the browser cannot decode it (HEIC outside Safari). */
export async function drawPicture(id: string, photo: Blob): Promise<void> {
  let picture: Blob | undefined;
  try {
    const bitmap = await createImageBitmap(photo, { resizeWidth: WIDTH, resizeQuality: "medium" });
    const canvas = document.createElement("canvas");
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
    bitmap.close();
    picture = await new Promise<Blob | undefined>((resolve) =>
      canvas.toBlob((made) => resolve(made ?? undefined), "image/jpeg", 0.8),
    );
  } catch {
    picture = undefined;
  }
  show(id, picture);
  if (picture) await keepPicture(became.get(id) ?? id, picture).catch(() => undefined);
}

/** Let the file of the service have the picture of the item that it was. */
export function handOver(from: string, to: string): void {
  became.set(from, to);
  const address = addresses.value.get(from);
  if (address !== undefined) addresses.value = new Map(addresses.value).set(to, address);
  void pictureOf(from)
    .then(async (picture) => picture && (await keepPicture(to, picture)))
    .catch(() => undefined);
}

/** The address of a picture; it is looked up when first asked for. */
export function pictureAddress(id: string): string | null {
  const known = addresses.value.get(id);
  if (known === undefined) void lookUp(id);
  return known ?? null;
}

const sought = new Set<string>();

async function lookUp(id: string): Promise<void> {
  if (sought.has(id)) return;
  sought.add(id);
  const picture = await pictureOf(id).catch(() => undefined);
  if (picture) {
    show(id, picture);
    return;
  }
  // The page was left before it was drawn; the photo itself is there until the service has it.
  const photo = await bytesOf(id).catch(() => undefined);
  if (photo) await drawPicture(id, photo);
}
