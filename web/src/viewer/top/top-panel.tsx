/** The cube's own picture, seen from above, with a cursor that is linked with the three-dimensional view. */
import { useEffect, useState } from "preact/hooks";
import { BASE } from "../../api/client";
import { asProblem, type Problem } from "../../api/problem";
import { texts } from "../../i18n";
import { Loading, ProblemBox } from "../../ui/boxes";
import type { PanelProps } from "../viewer";

const en = {
  picture: "The cloud in the cube’s pixels; a tap shows the spectrum of the point",
  hint: "The ring is the point under the pointer, here or in the other view.",
};
const it: typeof en = {
  picture: "La nuvola nei pixel del cubo; un tocco mostra lo spettro del punto",
  hint: "L’anello è il punto sotto il puntatore, qui o nell’altra vista.",
};
const t = texts({ en, it });

interface Grid {
  pixels: Uint16Array;
  rows: number;
  columns: number;
  /** Point of each pixel, row by row; -1 where there is none. */
  points: Int32Array;
}

/** Which point each pixel of the cube has. */
export function gridOf(pixels: Uint16Array, rows: number, columns: number): Grid {
  const points = new Int32Array(rows * columns).fill(-1);
  for (let i = 0; i < pixels.length / 2; i++) {
    const row = pixels[i * 2] as number, column = pixels[i * 2 + 1] as number;
    if (row < rows && column < columns) points[row * columns + column] = i;
  }
  return { pixels, rows, columns, points };
}

export default function TopPanel({ model }: PanelProps) {
  const [grid, setGrid] = useState<Grid | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => {
    const shape = model.loader.attributes.cube_shape;
    const [rows = 0, columns = 0] = Array.isArray(shape) ? (shape as number[]) : [];
    model.loader.array("hsi_pixel", 2).then(
      (pixels) => setGrid(gridOf(pixels as Uint16Array, rows, columns)),
      (thrown: unknown) => setProblem(asProblem(thrown)),
    );
  }, [model]);
  if (!grid) return problem ? <ProblemBox problem={problem} /> : <Loading />;
  const at = (event: MouseEvent): number | null => {
    const box = (event.currentTarget as Element).getBoundingClientRect();
    const row = Math.floor(((event.clientY - box.top) / box.height) * grid.rows);
    const column = Math.floor(((event.clientX - box.left) / box.width) * grid.columns);
    const point = grid.points[row * grid.columns + column] ?? -1;
    return point < 0 ? null : point;
  };
  const cursor = model.cursor.value;
  const unit = grid.columns / 100;
  return (
    <>
      <svg
        class="top-view"
        viewBox={`0 0 ${grid.columns} ${grid.rows}`}
        role="img"
        aria-label={t("picture")}
        data-testid="top-view"
        data-cursor={cursor ?? ""}
        onPointerMove={(event) => (model.cursor.value = at(event))}
        onPointerLeave={() => (model.cursor.value = null)}
        onClick={(event) => {
          const index = at(event);
          if (index !== null) void model.choose(index, event.shiftKey || model.keep.value);
        }}
      >
        <image href={`${BASE}/v1/clouds/${model.info.id}/previews/rgb.png?grid=cube`} width={grid.columns} height={grid.rows} />
        {model.spectra.curves.value.map(({ index, colour }) =>
          index === undefined ? null : <Ring grid={grid} point={index} colour={colour} unit={unit} />,
        )}
        {cursor !== null && <Ring grid={grid} point={cursor} colour="#000" unit={unit} />}
      </svg>
      <p class="small">{t("hint")}</p>
    </>
  );
}

function Ring({ grid, point, colour, unit }: { grid: Grid; point: number; colour: string; unit: number }) {
  const row = grid.pixels[point * 2] ?? 0, column = grid.pixels[point * 2 + 1] ?? 0;
  return (
    <>
      <circle cx={column + 0.5} cy={row + 0.5} r={2.2 * unit} fill="none" stroke="#fff" stroke-width={1.2 * unit} />
      <circle cx={column + 0.5} cy={row + 0.5} r={2.2 * unit} fill="none" stroke={colour} stroke-width={0.5 * unit} />
    </>
  );
}
