/** How the points are coloured: mode, bands, colour map and range, label layer. */
import { useEffect, useRef } from "preact/hooks";
import { number } from "../../i18n";
import { COLOUR_MAPS, colourTable } from "../colour/colour-maps";
import { hasScale, type Scale } from "../colour/colouring";
import { FLAGS } from "../colour/flags";
import { ticks } from "../colour/scale";
import { t } from "../texts";
import { MODES, type Mode, type ViewState } from "../view-state";
import type { PanelProps } from "../viewer";
import { BandField, BandPlayer } from "./band-player";
import { Choice, NumberField, Slider } from "./fields";
import { LayerChoice } from "./layer-choice";

/** Modes whose range is kept from one to the other would be another quantity's. */
const rangeless = (mode: Mode): Partial<ViewState> => ({ mode, range: null, map: mode === "difference" ? "balance" : "viridis" });

export function ColourPanel({ model }: PanelProps) {
  const state = model.state.value;
  const scale = model.colouring.value?.scale.value ?? null;
  const [r, g, b] = state.bands;
  return (
    <>
      <Choice
        label={t("show")}
        testid="colour-mode"
        value={state.mode}
        options={MODES.map((mode) => [mode, t(mode)] as const)}
        onChange={(mode) => model.patch(rangeless(mode))}
      />
      {state.mode === "band" && <BandPlayer model={model} />}
      {state.mode === "composite" && (
        <>
          <BandField model={model} label={t("red")} value={r} onInput={(band) => model.patch({ bands: [band, g, b] })} />
          <BandField model={model} label={t("green")} value={g} onInput={(band) => model.patch({ bands: [r, band, b] })} />
          <BandField model={model} label={t("blue")} value={b} onInput={(band) => model.patch({ bands: [r, g, band] })} />
        </>
      )}
      {(state.mode === "ratio" || state.mode === "difference") && (
        <>
          <BandField
            model={model}
            label={t("bandA")}
            value={state.pair[0]}
            onInput={(band) => model.patch({ pair: [band, state.pair[1]] })}
          />
          <BandField
            model={model}
            label={t("bandB")}
            value={state.pair[1]}
            onInput={(band) => model.patch({ pair: [state.pair[0], band] })}
          />
        </>
      )}
      {hasScale(state.mode) && scale && <RangeFields model={model} scale={scale} />}
      {state.mode === "flags" && (
        <ul class="legend">
          {FLAGS.map(({ key, colour }) => (
            <li>
              <span class="swatch" style={{ backgroundColor: colour }} aria-hidden="true" />
              {t(key)}
            </li>
          ))}
        </ul>
      )}
      <LayerChoice model={model} />
    </>
  );
}

/** What the numbers of a scale are in. */
export function unitOf(mode: Mode, quantity: string): string {
  return mode === "height" || mode === "sigma" ? t("mm") : mode === "band" ? quantity : "";
}

function RangeFields({ model, scale }: PanelProps & { scale: Scale }) {
  const state = model.state.value;
  const [low, high] = scale.range;
  const [least, most] = scale.limits;
  const step = Number(((most - least) / 200).toPrecision(1));
  const set = (from: number, to: number): void => {
    if (from < to) model.patch({ range: [from, to] });
  };
  const digits = Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(high - low))));
  const text = (value: number): string => number(value, digits);
  const inSlider = (value: number): number => Math.min(most, Math.max(least, value));
  return (
    <>
      <ColourBar map={state.map} />
      <div class="ticks" aria-hidden="true">
        <span>{text(low)}</span>
        {ticks([low, high], 3).slice(0, 1).map(() => (
          <span>{unitOf(state.mode, model.info.quantity)}</span>
        ))}
        <span>{text(high)}</span>
      </div>
      <Slider
        label={t("low")}
        testid="range-low"
        min={least}
        max={most}
        step={step}
        value={inSlider(low)}
        text={text(low)}
        onInput={(value) => set(value, high)}
      />
      <Slider
        label={t("high")}
        testid="range-high"
        min={least}
        max={most}
        step={step}
        value={inSlider(high)}
        text={text(high)}
        onInput={(value) => set(low, value)}
      />
      <div class="row">
        <NumberField label={t("low")} value={Number(low.toPrecision(5))} onChange={(value) => set(value, high)} />
        <NumberField label={t("high")} value={Number(high.toPrecision(5))} onChange={(value) => set(low, value)} />
      </div>
      <div class="row">
        <Choice
          label={t("map")}
          testid="colour-map"
          value={state.map}
          options={COLOUR_MAPS.map((name) => [name, name] as const)}
          onChange={(map) => model.patch({ map })}
        />
      </div>
      <button type="button" disabled={state.range === null} onClick={() => model.patch({ range: null })}>
        {t("automatic")}
      </button>
      <p class="small" role="status" data-testid="exactness" data-exact={String(scale.exact)}>
        {scale.exact ? "" : t("exactSoon")}
      </p>
    </>
  );
}

function ColourBar({ map }: { map: ViewState["map"] }) {
  const ref = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const context = ref.current?.getContext("2d");
    if (!context) return;
    const table = colourTable(map);
    const line = context.createImageData(256, 1);
    for (let i = 0; i < 256; i++) line.data.set([...table.subarray(i * 3, i * 3 + 3), 255], i * 4);
    context.putImageData(line, 0, 0);
  }, [map]);
  return <canvas ref={ref} class="colour-bar" width={256} height={1} aria-hidden="true" data-testid="colour-bar" />;
}
