/** The curves in one plot, with zoom; bad bands lie on grey. */
import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { badSpans } from "./plot-data";
import type { SpectrumCurve } from "./spectra-store";
import { t } from "./texts";

interface Given {
  curves: readonly SpectrumCurve[];
  wavelengths: readonly (number | null)[];
  badBands: readonly number[];
  quantity: string;
}

const HEIGHT = 240;
const colourOf = (name: string): string => getComputedStyle(document.documentElement).getPropertyValue(name);

export function SpectrumPlot({ curves, wavelengths, badBands, quantity }: Given) {
  const box = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | null>(null);
  useEffect(() => {
    const element = box.current;
    if (!element) return;
    const named = wavelengths.every((nm) => nm !== null);
    const order = bandOrder(wavelengths);
    const x = order.map((band) => (named ? (wavelengths[band] ?? 0) : band));
    const values = (of: ArrayLike<number>): (number | null)[] =>
      order.map((band) => (Number.isFinite(of[band]) ? (of[band] ?? null) : null));
    const series: uPlot.Series[] = [{}];
    const data: (number | null)[][] = [x];
    const bands: uPlot.Band[] = [];
    for (const { mean, sd, colour, name, kind } of curves) {
      series.push({ label: name, stroke: colour, width: 2, points: { show: false }, dash: kind === "reference" ? [6, 4] : [] });
      data.push(values(mean));
      if (!sd) continue;
      for (const sign of [1, -1]) {
        series.push({ stroke: `${colour}00`, width: 0, points: { show: false } });
        data.push(values(Array.from(mean, (m, band) => m + sign * (sd[band] ?? NaN))));
      }
      bands.push({ series: [series.length - 2, series.length - 1], fill: `${colour}33` });
    }
    const text = colourOf("--text"), line = colourOf("--line");
    const axis = { stroke: text, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 } };
    const made = new uPlot(
      {
        width: element.clientWidth,
        height: HEIGHT,
        series,
        bands,
        scales: { x: { time: false } },
        legend: { show: false },
        cursor: { drag: { x: true, y: false } },
        axes: [
          { ...axis, label: named ? t("wavelength") : t("bandAxis") },
          { ...axis, label: quantity === "reflectance" ? t("reflectance") : t("counts"), size: 64 },
        ],
        hooks: { drawClear: [(u) => greyBands(u, badSpans(x, order, badBands))] },
      },
      data as uPlot.AlignedData,
      element,
    );
    plot.current = made;
    const watch = new ResizeObserver(() => made.setSize({ width: element.clientWidth, height: HEIGHT }));
    watch.observe(element);
    return () => {
      watch.disconnect();
      made.destroy();
    };
  }, [curves, wavelengths, badBands, quantity]);
  return <div ref={box} class="plot" role="img" aria-label={`${t("plot")}: ${curves.map((c) => c.name).join("; ")}`} data-testid="spectrum-plot" />;
}

/** Bands in the order of their wavelengths. */
export function bandOrder(wavelengths: readonly (number | null)[]): number[] {
  const order = wavelengths.map((_, band) => band);
  return wavelengths.every((nm) => nm !== null) ? order.sort((a, b) => (wavelengths[a] ?? 0) - (wavelengths[b] ?? 0)) : order;
}

function greyBands(u: uPlot, spans: readonly (readonly [number, number])[]): void {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.fillStyle = "rgba(128, 128, 128, 0.3)";
  for (const [from, to] of spans) {
    const left = u.valToPos(from, "x", true);
    ctx.fillRect(left, bbox.top, u.valToPos(to, "x", true) - left, bbox.height);
  }
  ctx.restore();
}
