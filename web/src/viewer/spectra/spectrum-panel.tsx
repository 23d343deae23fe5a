/** The spectra that are looked at: plot, list, comparison, files. */
import { useState } from "preact/hooks";
import { number } from "../../i18n";
import { t as common } from "../../i18n/common";
import { ProblemBox } from "../../ui/boxes";
import { saveFile, savePlotPicture } from "../figure/save-file";
import { Check, NumberField } from "../panels/fields";
import { useLasso } from "../select/lasso-tool";
import type { PanelProps } from "../viewer";
import { readReference, writeCurves } from "./csv";
import { plotSvg } from "./plot-data";
import { bandOrder, SpectrumPlot } from "./spectrum-plot";
import type { SpectrumCurve } from "./spectra-store";
import { t } from "./texts";

export default function SpectrumPanel({ model }: PanelProps) {
  const { spectra, info } = model;
  const curves = spectra.curves.value;
  const [radius, setRadius] = useState(1);
  const last = curves.findLast((curve) => curve.index !== undefined)?.index;
  const lasso = useLasso(model, (indices) => void spectra.addRegion(indices, t("region", { n: indices.length })));
  const averageAround = (): void => {
    const cloud = model.cloud.value;
    if (last === undefined || !cloud) return;
    void spectra.addRegion(cloud.within(cloud.place(last), radius), t("around", { r: number(radius, 1), number: last }));
  };
  return (
    <div data-testid="spectra" data-curves={curves.length} data-last-ms={Math.round(spectra.lastMs.value)}>
      {curves.length === 0 ? (
        <p class="small">{t("none")}</p>
      ) : (
        <>
          <SpectrumPlot curves={curves} wavelengths={info.wavelength_nm} badBands={info.bad_bands} quantity={info.quantity} />
          <p class="small">{t("zoom")}</p>
          <ul class="legend">
            {curves.map((curve) => (
              <CurveLine key={curve.id} curve={curve} onRemove={() => spectra.remove(curve.id)} />
            ))}
          </ul>
        </>
      )}
      {spectra.problem.value && <ProblemBox problem={spectra.problem.value} />}
      <Check label={t("keep")} testid="keep-spectra" checked={model.keep.value} onChange={(keep) => (model.keep.value = keep)} />
      <div class="row">
        <NumberField label={t("radius")} testid="radius" min={0.05} max={50} value={radius} onChange={setRadius} />
      </div>
      <div class="row">
        <button type="button" data-testid="mean-radius" disabled={last === undefined || spectra.busy.value} onClick={averageAround}>
          {t("meanAround")}
        </button>
        <button type="button" data-testid="mean-lasso" aria-pressed={lasso.on} onClick={lasso.toggle}>
          {lasso.on ? t("lassoOn") : t("lasso")}
        </button>
      </div>
      <ClassMeans model={model} />
      <ReferenceField model={model} />
      {curves.length > 0 && <Files model={model} />}
    </div>
  );
}

function CurveLine({ curve, onRemove }: { curve: SpectrumCurve; onRemove: () => void }) {
  const { details } = curve;
  return (
    <li>
      <span class="swatch" style={{ backgroundColor: curve.colour }} aria-hidden="true" />
      <span class="curve-text">
        {curve.name}
        {curve.n > 1 && <span class="small"> {t("of", { n: curve.n })}</span>}
        {details && (
          <span class="small block number" data-testid="point-details">
            {t("place", {
              x: number(details.xyz[0] ?? 0, 2),
              y: number(details.xyz[1] ?? 0, 2),
              z: number(details.xyz[2] ?? 0, 2),
              sigma: details.sigma_mm === null ? "–" : number(details.sigma_mm, 2),
              row: details.hsi_pixel[0] ?? 0,
              column: details.hsi_pixel[1] ?? 0,
            })}
          </span>
        )}
      </span>
      <button type="button" class="quiet" aria-label={t("remove", { name: curve.name })} onClick={onRemove}>
        ×
      </button>
    </li>
  );
}

/** Mean spectra of the classes of the layer that is shown. */
function ClassMeans({ model }: PanelProps) {
  const layer = model.layers.shown.value;
  if (!layer) return null;
  const average = async (): Promise<void> => {
    for (const { value, name, colour } of layer.classes) {
      if (!colour) continue;
      const indices: number[] = [];
      layer.values.forEach((own, i) => own === value && indices.push(i));
      if (indices.length > 0) await model.spectra.addRegion(indices, name, "class");
    }
  };
  return (
    <button type="button" data-testid="class-means" disabled={model.spectra.busy.value} onClick={() => void average()}>
      {t("classes")}
    </button>
  );
}

function ReferenceField({ model }: PanelProps) {
  const [fault, setFault] = useState<string | null>(null);
  const take = async (file: File): Promise<void> => {
    const reflectance = model.info.quantity === "reflectance";
    const read = file.size > 4_000_000 ? "columns" : readReference(await file.text(), file.name, reflectance);
    if (typeof read === "string") {
      setFault(t(`fault_${read}`, { name: file.name }));
      return;
    }
    const known = model.info.wavelength_nm.filter((nm) => nm !== null);
    const inside = known.some((nm) => nm >= (read.nm[0] ?? Infinity) && nm <= (read.nm.at(-1) ?? 0));
    setFault(inside ? null : t("fault_outside", { name: file.name }));
    if (inside) model.spectra.addReference(read);
  };
  return (
    <>
      <label>
        {t("reference")}
        <input
          type="file"
          accept=".csv,.txt,text/csv,text/plain"
          data-testid="reference"
          onChange={(event) => {
            const file = event.currentTarget.files?.[0];
            if (file) void take(file);
            event.currentTarget.value = "";
          }}
        />
      </label>
      {fault !== null && (
        <p class="box problem" role="alert" data-testid="reference-fault">
          {fault}
        </p>
      )}
    </>
  );
}

function Files({ model }: PanelProps) {
  const { info } = model;
  const curves = model.spectra.curves.value;
  const svg = (): string => {
    const named = info.wavelength_nm.every((nm) => nm !== null);
    const order = bandOrder(info.wavelength_nm);
    return plotSvg({
      x: order.map((band) => (named ? (info.wavelength_nm[band] ?? 0) : band)),
      order,
      bad: info.bad_bands,
      curves: curves.map((curve) => ({ ...curve, dashed: curve.kind === "reference" })),
      xLabel: named ? t("wavelength") : t("bandAxis"),
      yLabel: info.quantity === "reflectance" ? t("reflectance") : t("counts"),
    });
  };
  return (
    <div class="row">
      <button
        type="button"
        data-testid="spectra-csv"
        onClick={() => saveFile("spectra.csv", new Blob([writeCurves(info.wavelength_nm, curves)], { type: "text/csv" }))}
      >
        {t("csv")}
      </button>
      <button type="button" data-testid="spectra-png" onClick={() => void savePlotPicture("spectra.png", svg())}>
        {t("png")}
      </button>
      <button type="button" data-testid="spectra-svg" onClick={() => saveFile("spectra.svg", new Blob([svg()], { type: "image/svg+xml" }))}>
        {t("svg")}
      </button>
      <button type="button" onClick={() => model.spectra.clear()} title={common("delete")}>
        {t("clear")}
      </button>
    </div>
  );
}
