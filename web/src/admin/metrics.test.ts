import { expect, it } from "vitest";
import { byLabel, parseMetrics, valueOf } from "./metrics";

const TEXT = `# HELP specimap_jobs Jobs by state.
# TYPE specimap_jobs gauge
specimap_jobs{state="queued"} 3.0
specimap_jobs{state="say \\"hi\\", {x}"} 1.5e3
specimap_workers 2.0
specimap_requests_handle_seconds_bucket{le="+Inf",route="/v1"} 9
broken line
specimap_nothing NaN
`;

it("reads samples with their labels, and leaves out what is none", () => {
  const samples = parseMetrics(TEXT);
  expect(samples).toHaveLength(4);
  expect(valueOf(samples, "specimap_workers")).toBe(2);
  expect(valueOf(samples, "specimap_nothing")).toBeUndefined();
  expect([...byLabel(samples, "specimap_jobs", "state")]).toEqual([
    ["queued", 3],
    ['say "hi", {x}', 1500],
  ]);
});
