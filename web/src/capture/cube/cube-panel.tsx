/** The cube's files: picked or dropped, paired, sent, judged. */
import { useRef, useState } from "preact/hooks";
import { asProblem, type Problem } from "../../api/problem";
import { bytes } from "../../i18n";
import { ProblemBox } from "../../ui/boxes";
import { deleteFile } from "../acquisition-data";
import { said } from "../judgement-texts";
import type { CubeJudgement, File as StoredFile } from "../photos/checks";
import { ItemState } from "../photos/photo-card";
import { t } from "../texts";
import type { Item } from "../uploads/item";
import { add, giveBack } from "../uploads/queue";
import { announcedBytes, pairedUp, type CubeRole, type Pairing } from "./pairing";

interface Props {
  acquisition: string;
  files: readonly StoredFile[];
  pending: readonly Item[];
  complete: Record<CubeRole, boolean>;
  refresh: () => void;
}

/** What is wrong with picked files before any byte is sent. */
async function faultsOf(pairing: Pairing<File>): Promise<string[]> {
  const faults = pairing.crowded.length ? [t("crowded")] : [];
  if (pairing.foreign.length) faults.push(t("foreignFiles", { names: pairing.foreign.map(({ name }) => name).join(", ") }));
  for (const { file, role, part } of pairing.parts) {
    if (file.size === 0) faults.push(t("emptyFile", { name: file.name }));
    if (part !== "header" || file.size > 1_000_000) continue;
    const expected = announcedBytes(await file.text().catch(() => ""));
    const data = pairing.parts.find((other) => other.role === role && other.part === "data")?.file;
    if (expected !== null && data && data.size < expected) {
      faults.push(t("tooShort", { name: data.name, found: bytes(data.size), expected: bytes(expected) }));
    }
  }
  return faults;
}

export function CubePanel({ acquisition, files, pending, complete, refresh }: Props) {
  const [faults, setFaults] = useState<string[]>([]);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [over, setOver] = useState(false);

  const picked = async (given: readonly File[], role?: CubeRole): Promise<void> => {
    const fresh = giveBack(acquisition, given);
    const pairing = pairedUp(fresh, role);
    const found = await faultsOf(pairing);
    // A role that is complete takes nothing more: what is there is deleted first.
    const free = pairing.parts.filter((part) => !complete[part.role]);
    if (free.length < pairing.parts.length) found.push(t("cubeIsThere"));
    setFaults(found);
    if (pairing.crowded.length) return;
    for (const { file, role: as } of free) {
      if (file.size > 0) await add({ acquisition, role: as, file, name: file.name });
    }
  };
  const remove = async (file: StoredFile): Promise<void> => {
    try {
      await deleteFile(acquisition, file.id);
      setProblem(null);
      refresh();
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };
  const of = (role: CubeRole) => ({
    role,
    files: files.filter((file) => file.role === role),
    pending: pending.filter((item) => item.role === role),
    complete: complete[role],
    picked: (given: readonly File[]) => void picked(given, role === "cube" ? undefined : role),
    remove: (file: StoredFile) => void remove(file),
  });

  return (
    <section
      aria-labelledby="cube-title"
      class={`cube${over ? " over" : ""}`}
      data-testid="cube-drop"
      onDragOver={(event) => {
        event.preventDefault();
        setOver(true);
      }}
      onDragLeave={() => setOver(false)}
      onDrop={(event) => {
        event.preventDefault();
        setOver(false);
        void picked([...(event.dataTransfer?.files ?? [])]);
      }}
    >
      <h2 id="cube-title">{t("cube")}</h2>
      <RoleFiles {...of("cube")} label={t("chooseCube")} />
      {!complete.cube && <p class="small">{t("cubeDrop")}</p>}
      {faults.length > 0 && (
        <div class="box warning" role="alert" data-testid="cube-faults">
          {faults.map((text) => (
            <p>{text}</p>
          ))}
        </div>
      )}
      {problem && <ProblemBox problem={problem} />}
      <details open={[...files, ...pending].some(({ role }) => role === "white" || role === "dark")}>
        <summary>{t("references")}</summary>
        <h3>{t("white")}</h3>
        <RoleFiles {...of("white")} label={`${t("chooseFiles")}: ${t("white")}`} />
        <h3>{t("dark")}</h3>
        <RoleFiles {...of("dark")} label={`${t("chooseFiles")}: ${t("dark")}`} />
      </details>
    </section>
  );
}

interface RoleProps {
  role: CubeRole;
  label: string;
  files: readonly StoredFile[];
  pending: readonly Item[];
  complete: boolean;
  picked: (files: readonly File[]) => void;
  remove: (file: StoredFile) => void;
}

function RoleFiles({ role, label, files, pending, complete, picked, remove }: RoleProps) {
  const picker = useRef<HTMLInputElement>(null);
  const lacking = complete ? null : lackingPart(files, pending);
  return (
    <div data-testid={`${role}-files`}>
      {complete && (
        <p class="good" data-testid={`${role}-complete`}>
          ✓ {role === "cube" ? t("cubeThere") : t("referenceThere", { role: t(role) })}
        </p>
      )}
      <ul class="files">
        {files.map((file) => (
          <CubeFile key={file.id} file={file} remove={() => remove(file)} />
        ))}
        {pending.map((item) => (
          <li key={item.id} data-testid="pending-file" data-state={item.state}>
            {item.name} <span class="small">{bytes(item.size)}</span>
            <ItemState item={item} />
          </li>
        ))}
      </ul>
      {lacking && (
        <p class="box warning" data-testid="cube-lacks">
          {t(lacking === "header" ? "lacksHeader" : "lacksData")}
        </p>
      )}
      {!complete && (
        <>
          <button type="button" class={role === "cube" ? "big" : ""} onClick={() => picker.current?.click()}>
            {label}
          </button>
          <input
            ref={picker}
            type="file"
            multiple
            class="hidden"
            tabIndex={-1}
            aria-label={label}
            data-testid={`${role}-picker`}
            onChange={(event) => {
              const given = [...(event.currentTarget.files ?? [])];
              event.currentTarget.value = "";
              picked(given);
            }}
          />
        </>
      )}
    </div>
  );
}

function CubeFile({ file, remove }: { file: StoredFile; remove: () => void }) {
  const judgement = file.judgement as CubeJudgement;
  const words = said(judgement.code, judgement.reason, judgement.advice);
  const { rows, cols, bands, wavelength_nm: range } = judgement;
  const facts = { rows: rows ?? 0, cols: cols ?? 0, bands: bands ?? 0 };
  return (
    <li class={judgement.verdict} data-testid="cube-file" data-verdict={judgement.verdict}>
      <div class="row tight">
        <span class="fill">
          {file.name} <span class="small">{t(`part_${judgement.part}`)}, {bytes(file.size)}</span>
        </span>
        <button type="button" class="quiet danger" onClick={remove} aria-label={`${t("remove")}: ${file.name}`}>
          {t("remove")}
        </button>
      </div>
      {rows != null && judgement.part !== "data" && (
        <p class="small">
          {range ? t("cubeFacts", { ...facts, low: Math.round(range[0] ?? 0), high: Math.round(range[1] ?? 0) }) : t("cubeFactsBare", facts)}
        </p>
      )}
      {judgement.verdict !== "accepted" && (
        <p class={judgement.verdict === "refused" ? "bad" : "fair"}>
          {words.reason} {words.advice}
        </p>
      )}
    </li>
  );
}

/** The part that is still to be picked: neither the service nor this browser has it. */
function lackingPart(files: readonly StoredFile[], pending: readonly Item[]): "header" | "data" | null {
  const usable = files.filter(({ state }) => state === "accepted").map(({ judgement }) => judgement as CubeJudgement);
  const coming = pairedUp(pending.filter(({ state }) => state !== "failed")).parts.map(({ part }) => part);
  const parts = new Set([...usable.map(({ part }) => part), ...coming]);
  if (parts.has("whole") || parts.size !== 1) return null;
  return parts.has("header") ? "data" : "header";
}
