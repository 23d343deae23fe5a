/** Fields with their labels, as the panels use them. */
import { useId } from "preact/hooks";
import type { ComponentChildren } from "preact";

export function Choice<T extends string>(given: {
  label: string;
  value: T;
  options: readonly (readonly [T, string])[];
  onChange: (value: T) => void;
  testid?: string;
}) {
  const id = useId();
  return (
    <div>
      <label for={id}>{given.label}</label>
      <select id={id} data-testid={given.testid} value={given.value} onChange={(event) => given.onChange(event.currentTarget.value as T)}>
        {given.options.map(([value, text]) => (
          <option value={value} selected={value === given.value}>
            {text}
          </option>
        ))}
      </select>
    </div>
  );
}

export function Slider(given: {
  label: ComponentChildren;
  value: number;
  min: number;
  max: number;
  step: number;
  onInput: (value: number) => void;
  text?: string;
  testid?: string;
}) {
  const id = useId();
  return (
    <div>
      <label for={id}>{given.label}</label>
      <input
        id={id}
        type="range"
        data-testid={given.testid}
        min={given.min}
        max={given.max}
        step={given.step}
        value={given.value}
        aria-valuetext={given.text}
        onInput={(event) => given.onInput(event.currentTarget.valueAsNumber)}
      />
    </div>
  );
}

/** A number that counts when it is complete: with Enter, or when the field is left. */
export function NumberField(given: {
  label: string;
  value: number;
  step?: number | undefined;
  min?: number | undefined;
  max?: number | undefined;
  onChange: (value: number) => void;
  testid?: string;
}) {
  const id = useId();
  return (
    <div>
      <label for={id}>{given.label}</label>
      <input
        id={id}
        type="number"
        data-testid={given.testid}
        step={given.step ?? "any"}
        min={given.min}
        max={given.max}
        value={given.value}
        onChange={(event) => {
          const value = event.currentTarget.valueAsNumber;
          const inside = value >= (given.min ?? -Infinity) && value <= (given.max ?? Infinity);
          if (Number.isFinite(value) && inside) given.onChange(value);
          else event.currentTarget.value = String(given.value);
        }}
      />
    </div>
  );
}

export function Check(given: { label: string; checked: boolean; onChange: (checked: boolean) => void; testid?: string }) {
  return (
    <label class="check">
      <input
        type="checkbox"
        data-testid={given.testid}
        checked={given.checked}
        onChange={(event) => given.onChange(event.currentTarget.checked)}
      />
      {given.label}
    </label>
  );
}
