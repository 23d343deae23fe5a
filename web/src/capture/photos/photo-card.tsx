/** One photo: its picture, its verdict in words, what was looked at, and the way to take it again. */
import { number } from "../../i18n";
import { t as common } from "../../i18n/common";
import { said } from "../judgement-texts";
import { t } from "../texts";
import type { Item } from "../uploads/item";
import { again, discard } from "../uploads/queue";
import type { Photo } from "./checks";
import { pictureAddress } from "./pictures";

function Picture({ id, name }: { id: string; name: string }) {
  const address = pictureAddress(id);
  return address ? <img src={address} alt={name} loading="lazy" /> : <span class="no-picture">{name}</span>;
}

interface Shown {
  photo: Photo;
  markers: readonly number[];
  retake: () => void;
  remove: () => void;
}

export function PhotoCard({ photo, markers, retake, remove }: Shown) {
  const { judgement, name, label } = photo;
  const words = said(judgement.code, judgement.reason, judgement.advice);
  return (
    <li class={`photo ${judgement.verdict}`} data-testid="photo-card" data-verdict={judgement.verdict} data-code={judgement.code ?? ""}>
      <Picture id={photo.id} name={photo.state === "refused" ? name : label} />
      <p class="verdict" data-testid="verdict" title={name}>
        <span aria-hidden="true">{SIGNS[judgement.verdict]}</span> {t(judgement.verdict)}
      </p>
      <Checks photo={photo} markers={markers} />
      {judgement.verdict !== "accepted" && (
        <>
          <p>
            {words.reason} {words.advice}
          </p>
          <div class="row tight">
            <button type="button" class="primary" onClick={retake} data-testid="retake" aria-label={`${t("retake")}: ${label}`}>
              {t("retake")}
            </button>
            <button type="button" class="quiet danger" onClick={remove} aria-label={`${t("remove")}: ${label}`}>
              {t("remove")}
            </button>
          </div>
        </>
      )}
    </li>
  );
}

const SIGNS = { accepted: "✓", doubtful: "!", refused: "✕" } as const;
const BLURRED = new Set(["photo_blurred"]);
/** Share of a photo from which on highlights hide much of the surface. */
const MOST_CLIPPED = 0.05;
const BADLY_LIT = new Set(["photo_overexposed", "photo_underexposed"]);

function Checks({ photo: { judgement }, markers }: { photo: Photo; markers: readonly number[] }) {
  if (judgement.width === null) return null;
  const code = judgement.code ?? "";
  const mark = (good: boolean, text: string) => (
    <li class={good ? "good" : "bad"}>
      <span aria-hidden="true">{good ? "✓" : "✕"}</span> {text}
      <span class="hidden">: {t(good ? "yes" : "no")}</span>
    </li>
  );
  return (
    <ul class="checks" aria-label={t("checks")}>
      {mark(!BLURRED.has(code), t("sharp"))}
      {mark(!BADLY_LIT.has(code), t("light"))}
      {judgement.clipped != null && mark(judgement.clipped < MOST_CLIPPED, t("highlights", { share: number(100 * judgement.clipped, judgement.clipped > 0.1 ? 0 : 1) }))}
      {markers.length > 0 && (
        <li class="ids">
          {markers.map((id) => {
            const seen = judgement.marker_ids.includes(id);
            return (
              <span class={seen ? "seen" : "unseen"} title={t(seen ? "markerSeen" : "markerMissing", { id })}>
                {id}
                <span class="hidden">: {t(seen ? "yes" : "no")}</span>
              </span>
            );
          })}
        </li>
      )}
    </ul>
  );
}

export function ItemCard({ item }: { item: Item }) {
  return (
    <li class="photo pending" data-testid="pending-card" data-state={item.state}>
      <Picture id={item.id} name={item.name} />
      <ItemState item={item} />
    </li>
  );
}

/** How far a file on its way is, and what it needs. */
export function ItemState({ item }: { item: Item }) {
  const share = item.size ? Math.floor((100 * item.sent) / item.size) : 0;
  const words = item.trouble ? said(item.trouble.code, item.trouble.message, item.trouble.advice) : null;
  return (
    <div class="item-state">
      {(item.state === "sending" || item.sent > 0) && item.state !== "failed" && (
        <progress max={100} value={share} aria-label={item.name} />
      )}
      <p class="small">
        {item.state === "waiting" && t("waiting")}
        {item.state === "sending" && t("sending", { share })}
        {item.state === "checking" && t("checking")}
        {item.state === "resting" && t("resting", { s: Math.max(Math.ceil((item.retryAt - Date.now()) / 1000), 1) })}
        {item.state === "asking" && t("asking")}
        {item.state === "failed" && words && (
          <span class="bad">
            {words.reason} {words.advice}
          </span>
        )}
      </p>
      {(item.state === "failed" || item.state === "asking") && (
        <div class="row tight">
          {item.state === "failed" && (
            <button type="button" onClick={() => again(item.id)} aria-label={`${common("retry")}: ${item.name}`}>
              {common("retry")}
            </button>
          )}
          <button type="button" class="quiet danger" onClick={() => discard(item.id)} aria-label={`${t("discard")}: ${item.name}`}>
            {t("discard")}
          </button>
        </div>
      )}
    </div>
  );
}
