/** What keeps files from being sent, in plain words. */
import { useEffect, useState } from "preact/hooks";
import { t as common } from "../i18n/common";
import { t } from "./texts";
import { againAll, elsewhere, forgetful, full, items } from "./uploads/queue";

function useOnline(): boolean {
  const [online, setOnline] = useState(navigator.onLine);
  useEffect(() => {
    const look = (): void => setOnline(navigator.onLine);
    addEventListener("online", look);
    addEventListener("offline", look);
    return () => {
      removeEventListener("online", look);
      removeEventListener("offline", look);
    };
  }, []);
  return online;
}

export function Notices({ unreachable }: { unreachable: boolean }) {
  const online = useOnline();
  const resting = items.value.some(({ state, trouble }) => state === "resting" && trouble?.status !== 429);
  return (
    <div aria-live="polite" data-testid="notices">
      {!online && <p class="box warning">{t("offline")}</p>}
      {online && (resting || unreachable) && (
        <div class="box warning row">
          <span class="fill">{t("unreachable")}</span>
          <button type="button" onClick={againAll}>
            {common("retry")}
          </button>
        </div>
      )}
      {full.value && (
        <div class="box problem row">
          <span class="fill">
            {t("full")} <span lang="en">({full.value.message})</span>
          </span>
          <button type="button" onClick={againAll}>
            {common("retry")}
          </button>
        </div>
      )}
      {forgetful.value && <p class="box warning">{t("forgetful")}</p>}
      {elsewhere.value && <p class="box warning">{t("elsewhere")}</p>}
    </div>
  );
}
