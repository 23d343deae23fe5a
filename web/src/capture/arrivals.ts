/** What follows when a file of this browser was judged, whichever page is shown. */
import { deleteFile } from "./acquisition-data";
import { handOver } from "./photos/pictures";
import { begin, onArrival } from "./uploads/queue";

let begun = false;

/** Begin to send what waits; the better photo takes the place of the one it was taken for. */
export function beginUploads(): void {
  begin();
  if (begun) return;
  begun = true;
  onArrival((item, file) => {
    if (item.role === "photo") handOver(item.id, file.id);
    performance.measure(`specimap.verdict ${file.label}`, { start: item.added - performance.timeOrigin });
    if (item.replaces !== null && file.judgement.verdict === "accepted") {
      // If it cannot be deleted now, it stays as a photo that should be taken again.
      void deleteFile(item.acquisition, item.replaces).catch(() => undefined);
    }
  });
}
