/** Draws the present view into a picture of any size, tile by tile, and what explains it. */
import { WebGLRenderTarget } from "three";
import { number } from "../../i18n";
import { colourTable } from "../colour/colour-maps";
import { ticks } from "../colour/scale";
import { bandName } from "../panels/band-player";
import { unitOf } from "../panels/colour-panel";
import { pixelsPerMm, project } from "../render/projection";
import { t } from "../texts";
import type { ViewerModel } from "../viewer-model";
import { axesOf, scaleBar, tilesOf } from "./figure-layout";

export interface FigureWanted {
  width: number;
  white: boolean;
  scale: boolean;
  bar: boolean;
  axes: boolean;
}

const TILE = 2048;

export async function drawFigure(model: ViewerModel, wanted: FigureWanted): Promise<Blob> {
  const view = model.view.value;
  if (!view) throw new Error("There is no picture yet.");
  const { canvas } = view;
  const factor = wanted.width / canvas.clientWidth;
  const height = Math.round(canvas.clientHeight * factor);
  const sheet = document.createElement("canvas");
  sheet.width = wanted.width;
  sheet.height = height;
  const context = sheet.getContext("2d");
  if (!context) throw new Error("The browser cannot draw a picture of this size.");
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const background = wanted.white ? "#ffffff" : dark ? "#0b0e11" : "#e9ecef";
  view.drawTiles(background, wanted.width, height, tilesOf(wanted.width, height, TILE), (tile, pixels) => {
    const data = context.createImageData(tile.width, tile.height);
    // The GPU counts rows from below.
    for (let row = 0; row < tile.height; row++) {
      const from = (tile.height - 1 - row) * tile.width * 4;
      data.data.set(pixels.subarray(from, from + tile.width * 4), row * tile.width * 4);
    }
    context.putImageData(data, tile.x, tile.y);
  }, (w, h) => new WebGLRenderTarget(w, h, { samples: 4 }));
  const ink = wanted.white || !dark ? "#000" : "#fff";
  const unit = wanted.width / 1000;
  context.fillStyle = context.strokeStyle = ink;
  context.lineWidth = 2 * unit;
  context.font = `${Math.round(18 * unit)}px sans-serif`;
  if (wanted.bar) drawScaleBar(context, model, factor, unit);
  if (wanted.axes) drawAxes(context, model, unit);
  if (wanted.scale) drawColourBar(context, model, unit);
  return new Promise((resolve, reject) =>
    sheet.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The picture is too large for this browser."))), "image/png"),
  );
}

function drawScaleBar(context: CanvasRenderingContext2D, model: ViewerModel, factor: number, unit: number): void {
  const view = model.view.value;
  if (!view) return;
  const { width, height } = context.canvas;
  const p = view.projection();
  const depth = project(p, ...view.controls.target.toArray())?.depth ?? 1;
  const { mm, pixels } = scaleBar((pixelsPerMm(p) / depth) * factor, width);
  const x = 30 * unit, y = height - 30 * unit;
  context.fillRect(x, y, pixels, 5 * unit);
  context.textAlign = "center";
  context.fillText(`${number(mm, mm < 1 ? 1 : 0)} mm`, x + pixels / 2, y - 8 * unit);
}

function drawAxes(context: CanvasRenderingContext2D, model: ViewerModel, unit: number): void {
  const view = model.view.value;
  if (!view) return;
  const { width, height } = context.canvas;
  const x = width - 80 * unit, y = height - 80 * unit, length = 48 * unit;
  context.textAlign = "center";
  for (const { name, right, down } of axesOf(view.camera.matrixWorldInverse.elements)) {
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + right * length, y + down * length);
    context.stroke();
    context.fillText(name, x + right * length * 1.3, y + down * length * 1.3 + 6 * unit);
  }
}

function drawColourBar(context: CanvasRenderingContext2D, model: ViewerModel, unit: number): void {
  const scale = model.colouring.value?.scale.value;
  if (!scale) return;
  const { mode, map, band, pair } = model.state.value;
  const { width } = context.canvas;
  const w = 20 * unit, h = 260 * unit, x = width - 110 * unit, y = 60 * unit;
  const table = colourTable(map);
  for (let i = 0; i < 256; i++) {
    context.fillStyle = `rgb(${table[i * 3]} ${table[i * 3 + 1]} ${table[i * 3 + 2]})`;
    context.fillRect(x, y + h - ((i + 1) / 256) * h, w, h / 256 + 1);
  }
  context.fillStyle = context.strokeStyle;
  context.strokeRect(x, y, w, h);
  const [low, high] = scale.range;
  context.textAlign = "left";
  for (const at of ticks(scale.range)) {
    const place = y + h - ((at - low) / (high - low)) * h;
    context.fillRect(x + w, place - unit / 2, 6 * unit, unit);
    context.fillText(String(at), x + w + 10 * unit, place + 6 * unit);
  }
  const [a, b] = pair.map((of) => bandName(model, of));
  const names: Partial<Record<string, string>> = { band: bandName(model, band), ratio: `${a} / ${b}`, difference: `(${a} − ${b}) / (${a} + ${b})` };
  const what = names[mode] ?? t(mode);
  context.textAlign = "right";
  context.fillText([what, unitOf(mode, model.info.quantity)].filter(Boolean).join(", "), width - 20 * unit, 36 * unit);
}
