/** The plot as data and as a drawing of its own, without a DOM. */
import { ticks } from "../colour/scale";

/** Spans of the axis that bad bands cover: half-way to their neighbours. `x` rises; `order` names the band at each. */
export function badSpans(x: readonly number[], order: readonly number[], bad: readonly number[]): (readonly [number, number])[] {
  const isBad = new Set(bad);
  const spans: [number, number][] = [];
  const between = (i: number, j: number): number => ((x[i] ?? 0) + (x[j] ?? x[i] ?? 0)) / 2;
  order.forEach((band, i) => {
    if (!isBad.has(band)) return;
    const from = i > 0 ? between(i - 1, i) : (x[i] ?? 0);
    const to = i < x.length - 1 ? between(i, i + 1) : (x[i] ?? 0);
    const last = spans.at(-1);
    if (last && last[1] >= from) last[1] = to;
    else spans.push([from, to]);
  });
  return spans;
}

export interface DrawnCurve {
  name: string;
  colour: string;
  mean: ArrayLike<number>;
  sd?: ArrayLike<number> | undefined;
  dashed?: boolean;
}

interface Sheet {
  x: readonly number[];
  order: readonly number[];
  bad: readonly number[];
  curves: readonly DrawnCurve[];
  xLabel: string;
  yLabel: string;
}

const WIDTH = 640, HEIGHT = 400, LEFT = 70, TOP = 16, BOTTOM = 52, RIGHT = 16;

/** Draw the curves as an SVG file for papers. */
export function plotSvg({ x, order, bad, curves, xLabel, yLabel }: Sheet): string {
  const y = extent(curves, order);
  const [x0, x1] = [x[0] ?? 0, x.at(-1) ?? 1];
  const legend = curves.length * 16 + 8;
  const px = (value: number): number => round(LEFT + ((value - x0) / (x1 - x0 || 1)) * (WIDTH - LEFT - RIGHT));
  const py = (value: number): number => round(HEIGHT - BOTTOM - ((value - y[0]) / (y[1] - y[0])) * (HEIGHT - TOP - BOTTOM));
  const bottom = HEIGHT - BOTTOM;
  const parts = badSpans(x, order, bad).map(
    ([from, to]) => `<rect x="${px(from)}" y="${TOP}" width="${round(px(to) - px(from))}" height="${bottom - TOP}" fill="#ddd"/>`,
  );
  for (const at of ticks([x0, x1], 7)) {
    parts.push(`<path d="M${px(at)} ${bottom}v5" stroke="#000"/><text x="${px(at)}" y="${bottom + 18}" text-anchor="middle">${at}</text>`);
  }
  for (const at of ticks(y, 6)) {
    parts.push(`<path d="M${LEFT} ${py(at)}h-5" stroke="#000"/><text x="${LEFT - 8}" y="${py(at) + 4}" text-anchor="end">${at}</text>`);
  }
  for (const { mean, sd, colour } of curves) {
    if (!sd) continue;
    const finite = order.map((band, i) => [i, band] as const).filter(([, band]) => Number.isFinite(mean[band]) && Number.isFinite(sd[band]));
    const edge = (sign: number): string[] =>
      finite.map(([i, band]) => `${px(x[i] ?? 0)} ${py((mean[band] ?? 0) + sign * (sd[band] ?? 0))}`);
    parts.push(`<path d="M${[...edge(1), ...edge(-1).reverse()].join("L")}Z" fill="${colour}" fill-opacity="0.2"/>`);
  }
  for (const { mean, colour, dashed } of curves) {
    let path = "";
    order.forEach((band, i) => {
      const value = mean[band] ?? NaN;
      if (!Number.isFinite(value)) return;
      const joined = i > 0 && Number.isFinite(mean[order[i - 1] ?? -1]);
      path += `${joined ? "L" : "M"}${px(x[i] ?? 0)} ${py(value)}`;
    });
    parts.push(`<path d="${path}" fill="none" stroke="${colour}" stroke-width="1.5"${dashed ? ' stroke-dasharray="6 4"' : ""}/>`);
  }
  curves.forEach(({ name, colour }, i) => {
    const at = HEIGHT + i * 16;
    parts.push(`<path d="M${LEFT} ${at}h24" stroke="${colour}" stroke-width="3"/><text x="${LEFT + 32}" y="${at + 4}">${escaped(name)}</text>`);
  });
  return (
    `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${WIDTH} ${HEIGHT + legend}" font-family="sans-serif" font-size="12">` +
    `<rect width="${WIDTH}" height="${HEIGHT + legend}" fill="#fff"/>` +
    parts.join("") +
    `<path d="M${LEFT} ${TOP}V${bottom}H${WIDTH - RIGHT}" fill="none" stroke="#000"/>` +
    `<text x="${(LEFT + WIDTH - RIGHT) / 2}" y="${HEIGHT - 14}" text-anchor="middle">${escaped(xLabel)}</text>` +
    `<text transform="translate(16 ${(TOP + bottom) / 2}) rotate(-90)" text-anchor="middle">${escaped(yLabel)}</text></svg>\n`
  );
}

function extent(curves: readonly DrawnCurve[], order: readonly number[]): readonly [number, number] {
  let low = Infinity, high = -Infinity;
  for (const { mean, sd } of curves) {
    for (const band of order) {
      const value = mean[band] ?? NaN, off = sd?.[band] ?? 0;
      if (!Number.isFinite(value)) continue;
      low = Math.min(low, value - off);
      high = Math.max(high, value + off);
    }
  }
  if (!(high > low)) return [Number.isFinite(low) ? low - 0.5 : 0, Number.isFinite(high) ? high + 0.5 : 1];
  const margin = (high - low) * 0.05;
  return [low - margin, high + margin];
}

function round(value: number): number {
  return Math.round(value * 100) / 100;
}

function escaped(text: string): string {
  return text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);
}
