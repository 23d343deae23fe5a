/** The live picture of the rear camera with its shutter. */
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { t } from "../texts";
import { CameraTrouble, closeCamera, openCamera, takeFrame } from "./camera";

/** Below this, markers at the usual distance are shorter than 30 pixels. */
const LEAST_PX = 1280;

interface Props {
  /** What this photo is taken for, where it takes another's place. */
  hint: string | null;
  /** How the last photo was judged, and what comes next. */
  status: ComponentChildren;
  take: (photo: Blob) => void;
  close: () => void;
}

export function CameraView({ hint, status, take, close }: Props) {
  const video = useRef<HTMLVideoElement>(null);
  const [trouble, setTrouble] = useState<CameraTrouble | null>(null);
  const [size, setSize] = useState<{ w: number; h: number } | null>(null);
  const [flash, setFlash] = useState(false);

  useEffect(() => {
    let stream: MediaStream | null = null;
    let lock: WakeLockSentinel | null = null;
    let ended = false;
    openCamera().then(
      async (opened) => {
        stream = opened;
        const shown = video.current;
        if (ended || !shown) {
          closeCamera(opened);
          return;
        }
        shown.srcObject = opened;
        await shown.play().catch(() => undefined);
        if ("wakeLock" in navigator) lock = await navigator.wakeLock.request("screen").catch(() => null);
      },
      (thrown: unknown) => {
        if (!ended) setTrouble(thrown instanceof CameraTrouble ? thrown : new CameraTrouble("cameraFailed", String(thrown)));
      },
    );
    return () => {
      ended = true;
      closeCamera(stream);
      void lock?.release();
    };
  }, []);

  const shoot = async (): Promise<void> => {
    if (!video.current) return;
    setFlash(true);
    setTimeout(() => setFlash(false), 120);
    try {
      take(await takeFrame(video.current));
    } catch (thrown) {
      setTrouble(thrown instanceof CameraTrouble ? thrown : new CameraTrouble("cameraFailed", String(thrown)));
    }
  };

  if (trouble) {
    return (
      <div class="box warning" role="alert" data-testid="camera-trouble">
        <p>{t(trouble.key, { what: trouble.what })}</p>
        <button type="button" onClick={close}>
          {t("closeCamera")}
        </button>
      </div>
    );
  }
  const small = size !== null && Math.max(size.w, size.h) < LEAST_PX;
  return (
    <div class={`viewfinder${flash ? " flash" : ""}`} data-testid="camera">
      {hint && (
        <p class="box warning" role="status">
          {hint}
        </p>
      )}
      <video
        ref={video}
        playsInline
        muted
        aria-label={t("camera")}
        onLoadedMetadata={(event) => setSize({ w: event.currentTarget.videoWidth, h: event.currentTarget.videoHeight })}
      />
      <div class="shutter-bar">
        <span class="small">{size && t("frame", size)}</span>
        <button type="button" class="shutter" data-testid="shutter" disabled={size === null} onClick={() => void shoot()} aria-label={t("shutter")} />
        <button type="button" class="quiet" onClick={close} data-testid="close-camera">
          {t("closeCamera")}
        </button>
      </div>
      {status}
      {small && <p class="small fair">{t("cameraSmall", size)}</p>}
    </div>
  );
}
