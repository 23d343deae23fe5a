/** The device's rear camera: opened at its best, and one frame of it as a photo. */
import type { CaptureKey } from "../texts";

/** More than the pipeline uses, and as much as tablets give as a stream. */
const IDEAL = { width: 4032, height: 3024 };
const QUALITY = 0.93;

/** Why the camera cannot be used, as a text of the page. */
export class CameraTrouble extends Error {
  constructor(
    readonly key: CaptureKey,
    readonly what = "",
  ) {
    super(key);
  }
}

const TROUBLES: Record<string, CaptureKey> = {
  NotAllowedError: "cameraDenied",
  SecurityError: "cameraDenied",
  NotFoundError: "cameraNone",
  OverconstrainedError: "cameraNone",
  NotReadableError: "cameraBusy",
  AbortError: "cameraBusy",
};

/** Open the rear camera. Throws {@link CameraTrouble}. */
export async function openCamera(): Promise<MediaStream> {
  if (!isSecureContext) throw new CameraTrouble("cameraInsecure");
  if (!("mediaDevices" in navigator)) throw new CameraTrouble("cameraNone");
  try {
    return await navigator.mediaDevices.getUserMedia({
      audio: false,
      video: { facingMode: { ideal: "environment" }, width: { ideal: IDEAL.width }, height: { ideal: IDEAL.height } },
    });
  } catch (thrown) {
    const name = thrown instanceof Error ? thrown.name : "";
    throw new CameraTrouble(TROUBLES[name] ?? "cameraFailed", thrown instanceof Error ? thrown.message : String(thrown));
  }
}

/** Close a camera. */
export function closeCamera(stream: MediaStream | null): void {
  stream?.getTracks().forEach((track) => track.stop());
}

/**
 * The frame that the video shows, as a JPEG.
 *
 * A frame of the stream, not a still of the camera: it is there at once, and all photos of a session have the same
 * lens, zoom and shape, which stills of tablets do not.
 */
export async function takeFrame(video: HTMLVideoElement): Promise<Blob> {
  const canvas = document.createElement("canvas");
  canvas.width = video.videoWidth;
  canvas.height = video.videoHeight;
  canvas.getContext("2d")?.drawImage(video, 0, 0);
  return await new Promise((resolve, reject) =>
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new CameraTrouble("cameraFailed"))), "image/jpeg", QUALITY),
  );
}

/** A name for a photo, by its moment. */
export function photoName(now: Date): string {
  return `tablet-${now.toISOString().slice(0, 23).replace(/[-:.]/g, "").replace("T", "-")}.jpg`;
}
