/** The few figures of `/metrics` (Prometheus' text format) that the page shows. */

export interface Sample {
  name: string;
  labels: Record<string, string>;
  value: number;
}

/** Read the samples of a text; lines that are none are left out. */
export function parseMetrics(text: string): Sample[] {
  const samples: Sample[] = [];
  for (const line of text.split("\n")) {
    const found = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})?\s+(\S+)/.exec(line);
    if (found === null) continue;
    const [, name = "", inner = "", value = ""] = found;
    const labels = Object.fromEntries(
      [...inner.matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)].map(([, key = "", quoted = ""]) => [
        key,
        quoted.replace(/\\(.)/g, (_, c: string) => (c === "n" ? "\n" : c)),
      ]),
    );
    const number = value === "+Inf" ? Infinity : Number(value);
    if (!Number.isNaN(number)) samples.push({ name, labels, value: number });
  }
  return samples;
}

/** The values of one metric by one of its labels. */
export function byLabel(samples: readonly Sample[], name: string, label: string): Map<string, number> {
  return new Map(samples.filter((s) => s.name === name).map((s) => [s.labels[label] ?? "", s.value]));
}

/** The value of a metric without labels. */
export function valueOf(samples: readonly Sample[], name: string): number | undefined {
  return samples.find((s) => s.name === name)?.value;
}
