/** Choosing a band: by slider, step by step, or as a film. */
import { useEffect, useState } from "preact/hooks";
import { number } from "../../i18n";
import { t } from "../texts";
import type { PanelProps } from "../viewer";
import type { ViewerModel } from "../viewer-model";
import { Slider } from "./fields";

const PLAY_MS = 250;

/** A band's wavelength, or its number where the cube names none. */
export function bandName(model: ViewerModel, band: number): string {
  const nm = model.info.wavelength_nm[band];
  const name = nm == null ? t("bandNumber", { number: band }) : `${number(nm, 1)} nm`;
  return model.info.bad_bands.includes(band) ? `${name}, ${t("bad")}` : name;
}

export function BandField(given: PanelProps & { label: string; value: number; onInput: (band: number) => void; testid?: string }) {
  const text = bandName(given.model, given.value);
  return (
    <Slider
      label={
        <>
          {given.label}: <span class="number">{text}</span>
        </>
      }
      {...(given.testid === undefined ? {} : { testid: given.testid })}
      min={0}
      max={given.model.info.bands - 1}
      step={1}
      value={given.value}
      text={text}
      onInput={given.onInput}
    />
  );
}

export function BandPlayer({ model }: PanelProps) {
  const [playing, setPlaying] = useState(false);
  const { band } = model.state.value;
  useEffect(() => {
    if (!playing) return;
    const timer = setInterval(() => model.patch({ band: stepped(model, model.state.peek().band, 1) }), PLAY_MS);
    return () => clearInterval(timer);
  }, [playing, model]);
  const step = (by: number): void => model.patch({ band: stepped(model, band, by) });
  return (
    <>
      <BandField model={model} label={t("band")} testid="band-slider" value={band} onInput={(chosen) => model.patch({ band: chosen })} />
      <div class="row">
        <button type="button" aria-label={t("earlier")} onClick={() => step(-1)}>
          ◂
        </button>
        <button type="button" data-testid="band-play" aria-pressed={playing} onClick={() => setPlaying(!playing)}>
          {playing ? t("pause") : t("play")}
        </button>
        <button type="button" aria-label={t("later")} onClick={() => step(1)}>
          ▸
        </button>
      </div>
    </>
  );
}

/** The next band that is not bad, around the end to the other. */
function stepped(model: ViewerModel, band: number, by: number): number {
  const { bands, bad_bands: bad } = model.info;
  let next = band;
  for (let i = 0; i < bands; i++) {
    next = (next + by + bands) % bands;
    if (!bad.includes(next)) return next;
  }
  return band;
}
