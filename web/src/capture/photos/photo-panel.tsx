import { useEffect, useRef, useState } from "preact/hooks";
import { asProblem, type Problem } from "../../api/problem";
import { ProblemBox } from "../../ui/boxes";
import { deleteFile } from "../acquisition-data";
import { said } from "../judgement-texts";
import { t } from "../texts";
import type { Item } from "../uploads/item";
import { add, giveBack } from "../uploads/queue";
import { CameraView } from "./camera-view";
import { photoName } from "./camera";
import { markersOf, maybePhoto, type Photo } from "./checks";
import { ItemCard, PhotoCard } from "./photo-card";
import { drawPicture } from "./pictures";

interface Props {
  acquisition: string;
  photos: readonly Photo[];
  pending: readonly Item[];
  camera: boolean;
  setCamera: (open: boolean) => void;
  /** Where to stand for the next photo, in words. */
  next: string | null;
  refresh: () => void;
}

export function PhotoPanel({ acquisition, photos, pending, camera, setCamera, next, refresh }: Props) {
  const [replaced, setReplaced] = useState<Photo | null>(null);
  const [refused, setRefused] = useState<string[]>([]);
  const [problem, setProblem] = useState<Problem | null>(null);
  const picker = useRef<HTMLInputElement>(null);
  const top = useRef<HTMLElement>(null);
  const markers = markersOf(photos);
  useEffect(() => {
    if (camera) top.current?.scrollIntoView({ block: "start" });
  }, [camera]);

  const send = async (photo: Blob, name: string): Promise<void> => {
    const replaces = replaced?.id ?? null;
    setReplaced(null);
    const item = await add({ acquisition, role: "photo", file: photo, name, replaces });
    await drawPicture(item.id, photo);
  };
  const picked = async (files: readonly File[]): Promise<void> => {
    const strange = files.filter((file) => !maybePhoto(file)).map(({ name }) => t("noPhotoFile", { name }));
    const empty = files.filter(({ size }) => size === 0).map(({ name }) => t("emptyFile", { name }));
    setRefused([...strange, ...empty]);
    const fresh = giveBack(acquisition, files.filter((one) => one.size > 0 && maybePhoto(one)));
    // All are on their way at once; their pictures are drawn one after the other, each takes the memory of a whole photo.
    const items = await Promise.all(fresh.map((file) => add({ acquisition, role: "photo", file, name: file.name })));
    for (const [n, item] of items.entries()) await drawPicture(item.id, fresh[n] ?? new Blob());
  };
  const remove = async (photo: Photo): Promise<boolean> => {
    try {
      await deleteFile(acquisition, photo.id);
      setProblem(null);
      refresh();
      return true;
    } catch (thrown) {
      setProblem(asProblem(thrown));
      return false;
    }
  };
  const retake = async (photo: Photo): Promise<void> => {
    // A doubtful photo is better than none: it goes when the better one is there.
    if (photo.judgement.verdict === "refused") {
      if (!(await remove(photo))) return;
    } else setReplaced(photo);
    setCamera(true);
    // The camera may be open already, and out of sight.
    top.current?.scrollIntoView({ block: "start" });
  };
  const hint = replaced && t("retaking", { name: replaced.label, advice: adviceOf(replaced) });

  return (
    <>
    <section ref={top} aria-labelledby="photos-title" class="photos shoot">
      <h2 id="photos-title">{t("photos")}</h2>
      {camera && (
        <CameraView
          hint={hint}
          status={<LastVerdict photos={photos} pending={pending} next={next} />}
          take={(photo) => void send(photo, photoName(new Date()))}
          close={() => {
            setCamera(false);
            setReplaced(null);
          }}
        />
      )}
      <div class="row">
        {!camera && (
          <button type="button" class="primary big" onClick={() => setCamera(true)} data-testid="open-camera">
            {t("openCamera")}
          </button>
        )}
        <button type="button" class="big" onClick={() => picker.current?.click()}>
          {t("pick")}
        </button>
        <input
          ref={picker}
          type="file"
          accept="image/*,.heic,.heif,.avif"
          multiple
          class="hidden"
          tabIndex={-1}
          aria-label={t("pick")}
          data-testid="pick-photos"
          onChange={(event) => {
            const files = [...(event.currentTarget.files ?? [])];
            event.currentTarget.value = "";
            void picked(files);
          }}
        />
      </div>
      {refused.length > 0 && (
        <div class="box problem" role="alert" data-testid="no-photo">
          {refused.map((text) => (
            <p>{text}</p>
          ))}
        </div>
      )}
      {problem && <ProblemBox problem={problem} />}
    </section>
    <section class="all-photos" aria-label={t("taken")}>
      {photos.length + pending.length === 0 && <p class="small">{t("noPhotos")}</p>}
      <ul class="cards" aria-label={t("photos")} data-testid="photo-cards">
        {[...pending].reverse().map((item) => (
          <ItemCard key={item.id} item={item} />
        ))}
        {sorted(photos).map((photo) => (
          <PhotoCard key={photo.id} photo={photo} markers={markers} retake={() => void retake(photo)} remove={() => void remove(photo)} />
        ))}
      </ul>
    </section>
    </>
  );
}

/** What the camera's user needs to know before the next photo. */
function LastVerdict({ photos, pending, next }: Pick<Props, "photos" | "pending" | "next">) {
  const last = photos.at(-1);
  const words = last && said(last.judgement.code, last.judgement.reason, last.judgement.advice);
  return (
    <div class="last-verdict" role="status" data-testid="last-verdict">
      {pending.length > 0 ? (
        <p>{t("checking")}</p>
      ) : (
        last &&
        words && (
          <p class={VERDICT_COLOURS[last.judgement.verdict]}>
            <strong>{t("last", { label: last.label, verdict: t(last.judgement.verdict) })}</strong> {words.reason} {words.advice}
          </p>
        )
      )}
      {next && <p>{next}</p>}
    </div>
  );
}

const VERDICT_COLOURS = { accepted: "good", doubtful: "fair", refused: "bad" } as const;

const ORDER = { refused: 0, doubtful: 0, accepted: 1 } as const;

/** Those to be taken again first, then the newest. */
function sorted(photos: readonly Photo[]): Photo[] {
  return [...photos].reverse().sort((a, b) => ORDER[a.judgement.verdict] - ORDER[b.judgement.verdict]);
}

function adviceOf({ judgement }: Photo): string {
  const { advice } = said(judgement.code, judgement.reason, judgement.advice);
  return advice.charAt(0).toLowerCase() + advice.slice(1);
}
