/** Everything of one acquisition on one page: photos on one side; viewpoints, cube and job on the other. */
import { useMemo, useState } from "preact/hooks";
import { number } from "../i18n";
import { Loading, ProblemBox } from "../ui/boxes";
import { deleteFile, useAcquisition } from "./acquisition-data";
import { CubePanel } from "./cube/cube-panel";
import { Dome, nextWords } from "./dome/dome";
import type { Viewpoints } from "./dome/geometry";
import { useViewpoints } from "./dome/viewpoints";
import { JobPanel } from "./job/job-panel";
import { Notices } from "./notices";
import { OrderPanel } from "./order/order-panel";
import { photosOf, tallied, WANTED } from "./photos/checks";
import { PhotoPanel } from "./photos/photo-panel";
import { t } from "./texts";
import { items } from "./uploads/queue";

export function CaptureView({ id }: { id: string }) {
  const { acquisition, files, problem, refresh } = useAcquisition(id);
  const all = items.value;
  const mine = useMemo(() => all.filter((item) => item.acquisition === id), [all, id]);
  const photos = useMemo(() => photosOf(files), [files]);
  const dome = useViewpoints(id, photos);
  const [camera, setCamera] = useState(false);
  if (!acquisition) return problem ? <ProblemBox problem={problem} again={refresh} /> : <Loading />;
  const { usable, again } = tallied(photos);
  const complete = { cube: acquisition.files.cube, white: acquisition.files.white, dark: acquisition.files.dark };
  const lost = problem !== null && (problem.status === 0 || problem.status >= 500);

  const retakeCube = async (): Promise<void> => {
    for (const file of files) if (file.role === "cube") await deleteFile(id, file.id);
    refresh();
    document.getElementById("cube-title")?.scrollIntoView({ block: "start" });
  };

  return (
    <div class="page capture" data-testid="capture">
      <header class="row">
        <h1 class="fill">{acquisition.specimen_id}</h1>
        <span class="small">{t("edgeOf", { mm: number(acquisition.edge_mm, 2) })}</span>
      </header>
      <p class="small">{t("hold")}</p>
      <Notices unreachable={lost} />
      {problem && !lost && <ProblemBox problem={problem} again={refresh} />}
      <OrderPanel acquisition={id} />
      <div class="sides">
        <PhotoPanel
          acquisition={id}
          photos={photos}
          pending={mine.filter(({ role }) => role === "photo")}
          camera={camera}
          setCamera={setCamera}
          next={dome ? nextWords(dome) : null}
          refresh={refresh}
        />
        <div class="aside">
          <Count usable={usable} again={again} dome={dome} />
          {dome && <Dome dome={dome} all={usable} />}
          <CubePanel acquisition={id} files={files} pending={mine.filter(({ role }) => role !== "photo")} complete={complete} refresh={refresh} />
          <JobPanel
            acquisition={acquisition}
            enough={dome?.enough === true}
            onTheWay={mine.filter(({ state }) => state !== "failed").length}
            retake={{ photos: () => setCamera(true), cube: retakeCube }}
          />
        </div>
      </div>
    </div>
  );
}

/** How many photos there are, and whether they will do. */
function Count({ usable, again, dome }: { usable: number; again: number; dome: Viewpoints | undefined }) {
  const enough = dome?.enough === true;
  return (
    <section class="count">
      <p data-testid="count" class={enough ? "good" : ""}>
        <strong>{t("count", { n: usable, of: WANTED })}</strong>
      </p>
      <progress max={WANTED} value={Math.min(usable, WANTED)} aria-label={t("photos")} />
      <p role="status" data-testid="advice" class={enough ? "good" : "small"}>
        {enough ? t("enough") : usable >= WANTED ? t("enoughCount", { n: usable }) : t("more", { n: WANTED - usable })}
      </p>
      {again > 0 && (
        <p class="row tight">
          <span class="fair fill">{t("retakeFirst", { n: again })}</span>
          <button type="button" onClick={showFirst}>
            {t("show")}
          </button>
        </p>
      )}
    </section>
  );
}

/** Bring the first photo that should be taken again into sight; such photos come first. */
function showFirst(): void {
  document.querySelector(".photo.refused, .photo.doubtful")?.scrollIntoView({ block: "center" });
}
