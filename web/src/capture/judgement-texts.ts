/** What a judgement or a failed job says, in the reader's language; the service's own words where a code is new here. */
import { language, texts } from "../i18n";

/** Each text: what is wrong, then what to do. */
export const en = {
  photo_unreadable: "It is no photo that can be opened.\nTake another, or choose the photo as the camera made it.",
  photo_raw: "It is a raw file.\nExport it as JPEG, or take another.",
  photo_too_large: "It has too many pixels.\nTake it with the camera's normal setting.",
  photo_too_small: "It has too few pixels: markers do not show.\nChoose the photo as the camera made it.",
  photo_duplicate: "The same photo is there already.\nTake another, from another side.",
  photo_blurred: "It is not sharp.\nHold still, and tap on the specimen to focus.",
  photo_overexposed: "A large part of it is overexposed.\nTake it with less light, or from where nothing glares.",
  photo_underexposed: "It is too dark.\nTake it with more light.",
  few_markers: "Fewer than two markers are read in it.\nTake it with all four markers whole in the picture.",
  no_markers_found: "No marker is read in it.\nTake it with all four markers whole in the picture, lit and not covered.",
  marker_dictionary_wrong: "Its markers are of another kind.\nUse the marker cards of this acquisition.",
  photo_foreign: "It comes from another camera, or was cropped.\nTake all photos with one camera, and do not crop.",
  judging_crashed: "It cannot be read: it is damaged.\nTake another.",
  judging_too_slow: "It takes too long to read: it is damaged.\nTake another.",
  cube_header_invalid: "The header has a wrong or missing field.\nExport the cube again.",
  cube_format_unknown: "It is no cube that can be read.\nExport it as ENVI (header and data), HDF5, NetCDF, MATLAB or TIFF.",
  cube_truncated: "The data are shorter than the header says.\nCopy the cube again.",
  cube_content_invalid: "There is nothing usable in it.\nLook at it in its own software, and record it again.",
  cube_not_examined: "There was no room to look into it.\nThe job will show whether it is good.",
  markers_missing_in_cube: "The cube shows fewer than two markers.\nTake it again with all four in view, lit, sharp and not covered.",
  marker_geometry_unsolvable: "The markers do not tell where the photos were taken.\nTake photos with two or more markers in each, from different sides.",
  marker_ids_duplicate: "Several markers have the same number.\nUse each marker once, then take photos and cube again.",
  depth_not_found: "No surface was found in the photos.\nTake more, neighbouring ones 10 to 20 degrees apart.",
  edge_implausible: "The edge of the markers cannot be right.\nMeasure the black square in millimetres, and make a new acquisition.",
  too_few_photos: "Too few photos can be used.\nTake more, sharp and with all markers.",
  photos_not_connected: "The photos do not hang together.\nTake more, neighbouring ones 10 to 20 degrees apart, with two markers or more.",
  registration_failed: "The cube cannot be laid onto the photos.\nTake the cube again, with all markers in view, lit and sharp.",
  result_insufficient: "The result covers too little of the specimen.\nTake more photos, from the sides that are missing.",
  state_conflict: "The service has such a file already, or works on it.\nDelete the one that is there first.",
  payload_too_large: "It is larger than the service takes.\nAsk the administrator for a higher limit.",
  memory_exhausted: "The job needs more memory than it may take.\nUse fewer or smaller photos, or ask the administrator.",
  worker_crashed: "The job's process ended again and again.\nTry it again, with fewer photos if it fails once more.",
  stage_timeout: "It took too long and was stopped.\nUse fewer or smaller photos.",
};
const it: typeof en = {
  photo_unreadable: "Non è una foto che si possa aprire.\nScattane un'altra, o scegli la foto come l'ha fatta la fotocamera.",
  photo_raw: "È un file raw.\nEsportalo come JPEG, o scattane un'altra.",
  photo_too_large: "Ha troppi pixel.\nScattala con l'impostazione normale della fotocamera.",
  photo_too_small: "Ha troppo pochi pixel: i marcatori non si vedono.\nScegli la foto come l'ha fatta la fotocamera.",
  photo_duplicate: "La stessa foto c'è già.\nScattane un'altra, da un altro lato.",
  photo_blurred: "Non è nitida.\nTieni fermo, e tocca il campione per mettere a fuoco.",
  photo_overexposed: "È in gran parte sovraesposta.\nScattala con meno luce, o da dove nulla abbaglia.",
  photo_underexposed: "È troppo scura.\nScattala con più luce.",
  few_markers: "Vi si leggono meno di due marcatori.\nScattala con tutti e quattro i marcatori interi nell'immagine.",
  no_markers_found: "Non vi si legge nessun marcatore.\nScattala con tutti e quattro interi nell'immagine, illuminati e non coperti.",
  marker_dictionary_wrong: "I suoi marcatori sono di un altro tipo.\nUsa i cartellini di questa acquisizione.",
  photo_foreign: "Viene da un'altra fotocamera, o è stata ritagliata.\nScatta tutte le foto con una sola fotocamera, senza ritagliarle.",
  judging_crashed: "Non si può leggere: è danneggiata.\nScattane un'altra.",
  judging_too_slow: "Ci vuole troppo a leggerla: è danneggiata.\nScattane un'altra.",
  cube_header_invalid: "L'intestazione ha un campo errato o mancante.\nEsporta di nuovo il cubo.",
  cube_format_unknown: "Non è un cubo che si possa leggere.\nEsportalo come ENVI (intestazione e dati), HDF5, NetCDF, MATLAB o TIFF.",
  cube_truncated: "I dati sono più corti di quanto dice l'intestazione.\nCopia di nuovo il cubo.",
  cube_content_invalid: "Non contiene nulla di utilizzabile.\nGuardalo nel suo programma, e acquisiscilo di nuovo.",
  cube_not_examined: "Non c'era spazio per esaminarlo.\nL'elaborazione mostrerà se va bene.",
  markers_missing_in_cube: "Il cubo mostra meno di due marcatori.\nRifallo con tutti e quattro in vista, illuminati, nitidi e non coperti.",
  marker_geometry_unsolvable: "I marcatori non dicono da dove sono state scattate le foto.\nScatta foto con due o più marcatori in ognuna, da lati diversi.",
  marker_ids_duplicate: "Più marcatori hanno lo stesso numero.\nUsa ogni marcatore una volta sola, poi rifai foto e cubo.",
  depth_not_found: "Nelle foto non è stata trovata una superficie.\nScattane altre, a 10–20 gradi l'una dall'altra.",
  edge_implausible: "Il lato dei marcatori non può essere giusto.\nMisura il quadrato nero in millimetri, e crea una nuova acquisizione.",
  too_few_photos: "Troppo poche foto sono utilizzabili.\nScattane altre, nitide e con tutti i marcatori.",
  photos_not_connected: "Le foto non si collegano tra loro.\nScattane altre, a 10–20 gradi l'una dall'altra, con due o più marcatori.",
  registration_failed: "Il cubo non si sovrappone alle foto.\nRifai il cubo, con tutti i marcatori in vista, illuminati e nitidi.",
  result_insufficient: "Il risultato copre troppo poco del campione.\nScatta altre foto, dai lati che mancano.",
  state_conflict: "Il servizio ha già un file così, o ci sta lavorando.\nElimina prima quello che c'è.",
  payload_too_large: "È più grande di quanto il servizio accetti.\nChiedi all'amministratore un limite più alto.",
  memory_exhausted: "L'elaborazione richiede più memoria di quanta possa usarne.\nUsa meno foto o più piccole, o chiedi all'amministratore.",
  worker_crashed: "Il processo dell'elaborazione si è interrotto più volte.\nRiprova, con meno foto se fallisce ancora.",
  stage_timeout: "Ci è voluto troppo e si è interrotta.\nUsa meno foto o più piccole.",
};
const t = texts({ en, it });

export interface Said {
  reason: string;
  advice: string;
}

/** Say a code in the reader's language. What is wrong, English readers get in the service's own, more exact words. */
export function said(code: string | null, reason: string, advice: string): Said {
  if (code === null || !(code in en)) return { reason, advice };
  const [what = "", todo = ""] = t(code as keyof typeof en).split("\n");
  return { reason: language.value === "en" && reason ? reason : what, advice: todo };
}
