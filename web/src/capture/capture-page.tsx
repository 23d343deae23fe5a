/** `#/capture`: a new acquisition. `#/capture/<acquisition>`: its photos, its cube and its job. */
import { useEffect } from "preact/hooks";
import { beginUploads } from "./arrivals";
import "./capture.css";
import { CaptureView } from "./capture-view";
import { NewAcquisition } from "./new-acquisition";

export default function Page({ parts }: { parts: readonly string[] }) {
  useEffect(beginUploads, []);
  const [acquisition] = parts;
  return acquisition === undefined ? <NewAcquisition /> : <CaptureView key={acquisition} id={acquisition} />;
}
