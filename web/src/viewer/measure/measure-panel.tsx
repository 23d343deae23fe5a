/** Measuring on the picture: lengths, ways along the surface, angles, areas. */
import { useEffect, useState } from "preact/hooks";
import { asProblem, type Problem } from "../../api/problem";
import { number } from "../../i18n";
import { ProblemBox } from "../../ui/boxes";
import { Choice } from "../panels/fields";
import { emptied, lineSegments, pieces } from "../render/lines";
import type { PanelProps } from "../viewer";
import type { Way } from "./geodesic";
import { angleAt, deviationOfLength, distance, lengthOf, outlineArea, type Place } from "./geometry";
import { surfaceGraph } from "./surface-source";
import { t } from "./texts";
import { useGroup } from "../render/use-group";

const KINDS = ["off", "line", "surface", "angle", "area"] as const;
type Kind = (typeof KINDS)[number];
const MOST: Record<Kind, number> = { off: 0, line: 200, surface: 2, angle: 3, area: 200 };
const HINTS = { off: null, line: "hint", surface: "hintSurface", angle: "hintAngle", area: "hintArea" } as const;
const COLOUR = [255, 200, 0] as const;

interface Measured {
  place: Place;
  sigma: number;
}

export default function MeasurePanel({ model }: PanelProps) {
  const [kind, setKind] = useState<Kind>("off");
  const [points, setPoints] = useState<readonly Measured[]>([]);
  const [way, setWay] = useState<Way | null | "reading">(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const group = useGroup(model);
  const view = model.view.value;

  useEffect(() => {
    if (kind === "off") return;
    const take = async (index: number): Promise<void> => {
      const cloud = model.cloud.value;
      if (!cloud) return;
      const sigmas = (await model.loader.array("sigma_mm", 1)) as Float32Array;
      const taken = { place: cloud.place(index), sigma: sigmas[index] ?? 0 };
      // One more than fits begins anew.
      setPoints((before) => (before.length >= MOST[kind] ? [taken] : [...before, taken]));
    };
    const tool = { name: "measure", tap: (index: number) => void take(index).catch((e: unknown) => setProblem(asProblem(e))) };
    model.tool.value = tool;
    return () => {
      if (model.tool.peek() === tool) model.tool.value = null;
    };
  }, [kind, model]);

  useEffect(() => {
    const [from, to] = points;
    if (kind !== "surface" || !from || !to) {
      setWay(null);
      return;
    }
    let left = false;
    setWay("reading");
    surfaceGraph(model.info.id).then(
      (graph) => !left && setWay(graph.way(from.place, to.place)),
      (thrown: unknown) => {
        setWay(null);
        setProblem(asProblem(thrown));
      },
    );
    return () => {
      left = true;
    };
  }, [kind, points, model]);

  useEffect(() => {
    if (!view) return;
    emptied(group);
    const line = way && way !== "reading" ? way.places : points.map(({ place }) => place);
    group.add(lineSegments(pieces(line, kind === "area"), COLOUR, true));
    group.add(lineSegments(points.flatMap(({ place }) => cross(place)), COLOUR, true));
    view.draw();
  }, [view, group, kind, points, way]);

  const hint = HINTS[kind];
  return (
    <div data-testid="measure" data-points={points.length}>
      <Choice
        label={t("kind")}
        testid="measure-kind"
        value={kind}
        options={KINDS.map((name) => [name, t(name)] as const)}
        onChange={(chosen) => {
          setKind(chosen);
          setPoints([]);
          setProblem(null);
        }}
      />
      {hint && <p class="small">{t(hint)}</p>}
      <p role="status" class="number" data-testid="measured">
        <strong>{result(kind, points, way)}</strong>
      </p>
      {problem && <ProblemBox problem={problem} />}
      {points.length > 0 && (
        <div class="row">
          <button type="button" onClick={() => setPoints(points.slice(0, -1))}>
            {t("back")}
          </button>
          <button type="button" onClick={() => setPoints([])}>
            {t("clear")}
          </button>
        </div>
      )}
    </div>
  );
}

function result(kind: Kind, points: readonly Measured[], way: Way | null | "reading"): string {
  const places = points.map(({ place }) => place);
  const [a, b, c] = places;
  switch (kind) {
    case "off":
      return "";
    case "line":
      return b
        ? t("mm", { value: number(lengthOf(places), 2), sd: number(deviationOfLength(places, points.map(({ sigma }) => sigma)), 2) })
        : "";
    case "surface":
      if (!a || !b) return "";
      if (way === "reading") return t("reading");
      return way
        ? t("between", { value: number(way.length, 2), low: number(distance(a, b), 2), high: number(way.upper, 2) })
        : t("apart");
    case "angle":
      return a && b && c ? t("degrees", { value: number(angleAt(a, b, c), 1) }) : "";
    case "area":
      return c ? t("square", { value: number(outlineArea(places), 1) }) : "";
  }
}

/** A small cross at a place. */
function cross([x, y, z]: Place, r = 0.35): (readonly [Place, Place])[] {
  return [
    [[x - r, y, z], [x + r, y, z]],
    [[x, y - r, z], [x, y + r, z]],
    [[x, y, z - r], [x, y, z + r]],
  ];
}
