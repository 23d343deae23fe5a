/** Small pictures of photos, made here: the service keeps originals only. */
import { signal } from "@preact/signals";
import { keepPicture, pictureOf } from "../uploads/storage";

const WIDTH = 320;

/** Addresses of pictures by the id of an item or of a file; null where there is none. */
const addresses = signal<ReadonlyMap<string, string | null>>(new Map());

function show(id: string, picture: Blob | undefined): void {
  addresses.value = new Map(addresses.value).set(id, picture ? URL.createObjectURL(picture) : null);
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
  if (picture) await keepPicture(id, picture).catch(() => undefined);
}

/** Let the file of the service have the picture of the item that it was. */
export function handOver(from: string, to: string): void {
  const address = addresses.value.get(from);
  if (address !== undefined) addresses.value = new Map(addresses.value).set(to, address);
  void pictureOf(from)
    .then(async (picture) => picture && (await keepPicture(to, picture)))
    .catch(() => undefined);
}

/** The address of a picture; it is looked up when first asked for. */
export function pictureAddress(id: string): string | null {
  const known = addresses.value.get(id);
  if (known === undefined) {
    void pictureOf(id).then(
      (picture) => show(id, picture),
      () => show(id, undefined),
    );
  }
  return known ?? null;
}
