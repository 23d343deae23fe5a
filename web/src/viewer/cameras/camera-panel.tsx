/** Markers, cameras and photos: shown in the picture, a photo by its camera. */
import { useEffect, useState } from "preact/hooks";
import { api, BASE, body, fetched } from "../../api/client";
import { usePolled } from "../../api/polling";
import { session } from "../../app/session";
import { texts } from "../../i18n";
import { Loading, ProblemBox } from "../../ui/boxes";
import type { Place } from "../measure/geometry";
import { Check, Choice } from "../panels/fields";
import { emptied, lineSegments, pieces } from "../render/lines";
import { project } from "../render/projection";
import type { PanelProps } from "../viewer";
import type { ViewerModel } from "../viewer-model";
import { centreOf, directionOf, distanceToPlane, frustum, type PhotoCamera } from "./camera-geometry";
import { useGroup } from "../render/use-group";

const en = {
  markers: "Show the markers’ corners",
  cameras: "Show the cameras",
  old: "This result was made by an earlier version, which kept no cameras.",
  photo: "Photo",
  none: "None",
  tap: "Tap a camera in the picture, or choose a photo.",
  stand: "Look from this camera",
  unseen: "The browser cannot show this photo’s format.",
  picture: "Photo {name}",
};
const it: typeof en = {
  markers: "Mostra gli angoli dei marcatori",
  cameras: "Mostra le fotocamere",
  old: "Questo risultato è di una versione precedente, che non conservava le fotocamere.",
  photo: "Foto",
  none: "Nessuna",
  tap: "Tocca una fotocamera nell’immagine, o scegli una foto.",
  stand: "Guarda da questa fotocamera",
  unseen: "Il browser non può mostrare il formato di questa foto.",
  picture: "Foto {name}",
};
const t = texts({ en, it });
const LENGTH_MM = 10;
const TAP_PX = 14;

interface Known {
  photos: PhotoCamera[] | null;
  corners: Place[][];
}

async function known(model: ViewerModel): Promise<Known> {
  const { id } = model.info;
  const corners = (await (await fetched(`/v1/clouds/${id}/corners`)).json()) as Record<string, Place[]>;
  try {
    const cameras = (await (await fetched(`/v1/clouds/${id}/cameras`)).json()) as { photos: PhotoCamera[] };
    return { photos: cameras.photos, corners: Object.values(corners) };
  } catch (thrown) {
    if ((thrown as { code?: string }).code !== "cameras_missing" && (thrown as { status?: number }).status !== 404) throw thrown;
    return { photos: null, corners: Object.values(corners) };
  }
}

export default function CameraPanel({ model }: PanelProps) {
  const { data, problem, again } = usePolled(`cameras ${model.info.id}`, () => known(model));
  const [shown, setShown] = useState({ markers: true, cameras: true });
  const [photo, setPhoto] = useState<PhotoCamera | null>(null);
  useDrawn(model, data, shown, photo);
  useTaps(model, shown.cameras ? (data?.photos ?? null) : null, setPhoto);
  if (!data) return problem ? <ProblemBox problem={problem} again={again} /> : <Loading />;
  const stand = (camera: PhotoCamera): void => {
    const centre = centreOf(camera), direction = directionOf(camera), far = distanceToPlane(camera);
    const target = centre.map((value, i) => value + (direction[i] ?? 0) * far);
    model.view.value?.setCamera([...centre, target[0] ?? 0, target[1] ?? 0, target[2] ?? 0]);
    model.view.value?.onRest();
  };
  return (
    <div data-testid="cameras" data-photos={data.photos?.length ?? 0}>
      <Check label={t("markers")} checked={shown.markers} onChange={(markers) => setShown({ ...shown, markers })} />
      {data.photos === null ? (
        <p class="small">{t("old")}</p>
      ) : (
        <>
          <Check label={t("cameras")} checked={shown.cameras} onChange={(cameras) => setShown({ ...shown, cameras })} />
          <Choice
            label={t("photo")}
            testid="photo-choice"
            value={photo?.name ?? ""}
            options={[["", t("none")], ...data.photos.map(({ name }) => [name, name] as const)]}
            onChange={(name) => setPhoto(data.photos?.find((camera) => camera.name === name) ?? null)}
          />
          {photo ? (
            <>
              <button type="button" data-testid="look-from" onClick={() => stand(photo)}>
                {t("stand")}
              </button>
              {session.value?.cloud_id == null && <PhotoPicture key={photo.name} model={model} name={photo.name} />}
            </>
          ) : (
            <p class="small">{t("tap")}</p>
          )}
        </>
      )}
    </div>
  );
}

function PhotoPicture({ model, name }: PanelProps & { name: string }) {
  const acquisition_id = model.info.acquisition_id;
  const [unseen, setUnseen] = useState(false);
  const { data, problem, again } = usePolled(`files ${acquisition_id}`, () =>
    body(api.GET("/v1/acquisitions/{acquisition_id}/files", { params: { path: { acquisition_id } } })),
  );
  if (!data) return problem ? <ProblemBox problem={problem} again={again} /> : <Loading />;
  const file = data.find(({ label }) => label === name);
  if (!file || unseen) return <p class="small">{t("unseen")}</p>;
  return (
    <img
      class="preview"
      data-testid="photo"
      src={`${BASE}/v1/acquisitions/${acquisition_id}/files/${file.id}/content`}
      alt={t("picture", { name })}
      onError={() => setUnseen(true)}
    />
  );
}

function useDrawn(model: ViewerModel, data: Known | undefined, shown: { markers: boolean; cameras: boolean }, photo: PhotoCamera | null): void {
  const group = useGroup(model);
  const view = model.view.value;
  useEffect(() => {
    if (!view || !data) return;
    emptied(group);
    if (shown.markers) group.add(lineSegments(data.corners.flatMap((corner) => pieces(corner, true)), [0, 160, 255], true));
    if (shown.cameras && data.photos) {
      group.add(lineSegments(data.photos.flatMap((camera) => frustum(camera, LENGTH_MM)), [130, 140, 150], false));
      if (photo) group.add(lineSegments(frustum(photo, LENGTH_MM * 1.4), [255, 150, 0], true));
    }
    view.draw();
  }, [view, group, data, shown, photo]);
}

/** A tap on a camera shows its photo instead of a spectrum. */
function useTaps(model: ViewerModel, photos: PhotoCamera[] | null, choose: (photo: PhotoCamera) => void): void {
  useEffect(() => {
    if (!photos) return;
    const take = (x: number, y: number): boolean => {
      const p = model.view.value?.projection();
      const near = p && photos.find((camera) => {
        const at = project(p, ...centreOf(camera));
        return at !== null && Math.hypot(at.x - x, at.y - y) <= TAP_PX;
      });
      if (near) choose(near);
      return near !== undefined;
    };
    model.tapFirst = take;
    return () => {
      model.tapFirst = null;
    };
  }, [model, photos, choose]);
}
