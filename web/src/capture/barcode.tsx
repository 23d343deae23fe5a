/** Read a specimen's id from a barcode with the camera. */
import { useEffect, useRef, useState } from "preact/hooks";
import { barcodeDetector, type Detector } from "./barcode-detector";
import { CameraTrouble, closeCamera, openCamera } from "./photos/camera";
import { isSpecimenId } from "./specimen-id";
import { t } from "./texts";

/** Milliseconds between looks at the picture. */
const PAUSE = 250;

export function Barcode({ found }: { found: (text: string) => void }) {
  const [open, setOpen] = useState(false);
  const [said, setSaid] = useState("");
  const read = (text: string): void => {
    if (isSpecimenId(text)) {
      setOpen(false);
      setSaid("");
      found(text);
    } else setSaid(t("scanBad", { text }));
  };
  return (
    <>
      <button type="button" onClick={() => setOpen(!open)} aria-expanded={open} data-testid="scan-barcode">
        {t("scan")}
      </button>
      {open && <Scanner read={read} failed={(text) => {
            setOpen(false);
            setSaid(text);
          }} />}
      {said && (
        <p class="box warning" role="alert">
          {said}
        </p>
      )}
    </>
  );
}

function Scanner({ read, failed }: { read: (text: string) => void; failed: (text: string) => void }) {
  const video = useRef<HTMLVideoElement>(null);
  const told = useRef({ read, failed });
  told.current = { read, failed };
  useEffect(() => {
    let stream: MediaStream | null = null;
    let timer: ReturnType<typeof setTimeout> | undefined;
    let ended = false;
    const look = async (detector: Detector): Promise<void> => {
      const shown = video.current;
      if (ended || !shown) return;
      const codes = shown.readyState >= 2 ? await detector.detect(shown).catch(() => []) : [];
      if (codes[0]) told.current.read(codes[0].rawValue.trim());
      timer = setTimeout(() => void look(detector), PAUSE);
    };
    openCamera().then(
      async (opened) => {
        stream = opened;
        if (ended || !video.current) {
          closeCamera(opened);
          return;
        }
        video.current.srcObject = opened;
        await video.current.play().catch(() => undefined);
        const detector = await barcodeDetector().catch(() => null);
        if (detector) await look(detector);
        else told.current.failed(t("scanFailed"));
      },
      (thrown: unknown) => {
        const trouble = thrown instanceof CameraTrouble ? thrown : new CameraTrouble("cameraFailed");
        if (!ended) told.current.failed(t(trouble.key, { what: trouble.what }));
      },
    );
    return () => {
      ended = true;
      clearTimeout(timer);
      closeCamera(stream);
    };
  }, []);
  return (
    <div class="viewfinder small-finder">
      <video ref={video} playsInline muted aria-label={t("scanHint")} />
      <p class="small">{t("scanHint")}</p>
    </div>
  );
}
