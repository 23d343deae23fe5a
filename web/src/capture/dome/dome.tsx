/** The dome of viewpoints: measured places of the photos, gaps, and where to stand next. */
import { number } from "../../i18n";
import { t, type CaptureKey } from "../texts";
import { markerScale, outline, placed, wayTo, type Viewpoints, type Way } from "./geometry";

const RADIUS = 100;
/** Side of a marker in the drawing, which shows where it lies, not how large it is. */
const CARD = 13;
const SIDES: Record<Way["side"], CaptureKey> = {
  here: "wayHere",
  right: "wayRight",
  left: "wayLeft",
  farRight: "wayFarRight",
  farLeft: "wayFarLeft",
  opposite: "wayOpposite",
};
const HEIGHTS: Record<Way["height"], CaptureKey> = { same: "waySame", higher: "wayHigher", lower: "wayLower", above: "wayAbove" };
/** Distances beyond which the page says something, mm. */
const NEAR_MM = 90;
const FAR_MM = 350;

/** Where to stand next, in words, from where the newest photo was taken; null where nothing is left or known. */
export function nextWords(dome: Viewpoints): string | null {
  const last = dome.photos.at(-1);
  if (!dome.next || !last) return null;
  const { side, height } = wayTo(last, dome.next);
  return t("wayNext", { side: t(SIDES[side]), height: t(HEIGHTS[height]) });
}

export function Dome({ dome, all }: { dome: Viewpoints; all: number }) {
  const { cells, photos, markers, next, unplaced } = dome;
  const last = photos.at(-1);
  const share = number(100 * dome.covered);
  const scale = markerScale(markers, RADIUS);
  const text = t("domeText", { photos: photos.length, all, share });
  const words = nextWords(dome);
  const from = last && placed(last, RADIUS);
  const to = next && placed(next, RADIUS);
  return (
    <section class="dome-panel" aria-labelledby="dome-title" data-testid="dome" data-covered={dome.covered} data-enough={String(dome.enough)}>
      <h2 id="dome-title">{t("dome")}</h2>
      <svg class="dome" viewBox="-112 -112 224 224" role="img" aria-label={`${text} ${words ?? ""}`}>
        {cells.map((cell) => (
          <path class={cell.covered ? "cell covered" : "cell"} d={outline(cell, RADIUS)} />
        ))}
        {markers.map(({ id, corners_mm }) => {
          const mean = (axis: 0 | 1): number => corners_mm.reduce((sum, corner) => sum + (corner[axis] ?? 0) / corners_mm.length, 0);
          const [x, y] = [mean(0) * scale, -mean(1) * scale];
          return (
            <g class="marker">
              <rect x={x - CARD / 2} y={y - CARD / 2} width={CARD} height={CARD} rx="2" />
              <text x={x} y={y}>
                {id}
              </text>
            </g>
          );
        })}
        {photos.map((photo) => {
          const { x, y } = placed(photo, RADIUS);
          return <circle class={photo === last ? "spot last" : "spot"} cx={x} cy={y} r={photo === last ? 5 : 3.5} />;
        })}
        {from && to && <line class="way" x1={from.x} y1={from.y} x2={to.x} y2={to.y} />}
        {to && photos.length > 0 && <circle class="next" cx={to.x} cy={to.y} r="9" />}
      </svg>
      <p class="small">{photos.length === 0 ? t("domeEmpty") : text}</p>
      {words && (
        <p class="next-words" data-testid="dome-next">
          {words}
        </p>
      )}
      {last && last.distance_mm < NEAR_MM && <p class="fair">{t("tooNear", { cm: number(last.distance_mm / 10) })}</p>}
      {last && last.distance_mm > FAR_MM && <p class="fair">{t("tooFar", { cm: number(last.distance_mm / 10) })}</p>}
      {unplaced.length > 0 && <p class="small">{t("domeUnplaced", { n: unplaced.length })}</p>}
    </section>
  );
}
