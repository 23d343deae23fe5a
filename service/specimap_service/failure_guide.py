"""``python -m specimap_service.failure_guide``: print the table of docs/operations.md, made from all errors."""

from __future__ import annotations

from specimap_service.http_status import HTTP_STATUS

HEADER = "| code | status | what you do |\n|---|---|---|"
OPERATOR = {
    "backend_failed": "See `details['last_lines']`: usually memory of the GPU. One job at a time, or fewer photos.",
    "backend_unavailable": "Run `specimap doctor` as the service's user; install what it names, or mount the weights.",
    "backup_invalid": "Take another backup; keep two places. `specimap restore --check` tells before you need one.",
    "cloud_damaged": "`specimap storage check --checksums`, then `--repair --from BACKUP`. Check the disk.",
    "database_damaged": "Stop the service, check the disk, restore the last backup into an empty folder.",
    "database_too_new": "Start the newer release again, or restore the backup from before the upgrade.",
    "database_unavailable": "See that PostgreSQL runs and has connections left. Jobs wait, and go on by themselves.",
    "forbidden": "Make a key with the scope that the work needs, not more.",
    "identity_unavailable": "See that the identity provider answers (`specimap identity check`). Keys go on working.",
    "internal_error": "Search the log for the correlation id and report it with the traceback.",
    "lost_lease": "Nothing once. Often: clocks, a frozen virtual machine or a slow database; see the worker's log.",
    "memory_exhausted": "Give workers more memory (the container's, `SPECIMAP_STAGE_MEMORY_BYTES`), or fewer slots.",
    "order_source_unavailable": "See that the worklist answers; [pacs.md](pacs.md#orders). Enter orders by hand.",
    "output_not_writable": "Give data and scratch folder to the service's user, with rights 0700.",
    "overloaded": "Nothing once. Often: another replica of the API, or find the key that asks so much (log: `key`).",
    "payload_too_large": "Raise the limit that it names, in the service and in the proxy, if the file is right.",
    "quota_exceeded": "Have old data deleted, or raise `SPECIMAP_QUOTA_BYTES`.",
    "rate_limited": "Nothing, or give this key a higher limit (`POST /v1/keys`, `rate_per_minute`).",
    "request_timeout": "Look at the network between client and proxy; `SPECIMAP_SILENCE_SECONDS` sets the wait.",
    "restore_target_not_empty": "Restore into a new data folder, or an empty database and bucket.",
    "setting_invalid": "At a start: correct what it names ([settings.md](settings.md)). In a job: its sender.",
    "stage_failed": "Keep the job, and report it with its log: a library failed on an input that no check caught.",
    "stage_timeout": "See whether the machine is overloaded; else raise `SPECIMAP_STAGE_SECONDS`.",
    "storage_full": "Free space or enlarge the disk; `SPECIMAP_KEEP_ARTEFACT_DAYS` frees some.",
    "storage_unavailable": "See that store and network work, and that the key may read and write the bucket.",
    "study_keys_missing": "Set `SPECIMAP_STUDY_KEYS` for all programs; [pacs.md](pacs.md#study-contexts).",
    "study_sealed": "Add the key that it was sealed with to `SPECIMAP_STUDY_KEYS`, after the newest.",
    "syslog_unavailable": "See that the syslog server answers, and its certificate is trusted. Nothing is lost.",
    "too_many_connections": "Raise `SPECIMAP_MAX_CONNECTIONS` and `LimitNOFILE`; limit single clients in the proxy.",
    "unauthorized": "Many of them: an expired key in a device, or somebody who guesses. `keys list` shows last use.",
    "worker_crashed": "See the worker's log and the kernel's (out of memory?). If other jobs succeed, report this one.",
}
"""What who runs the service does about a code. Every fault of the server's (5xx) is here."""
SENDER = "The others are for who sent the request or the files, by the advice in the answer: "


def failure_guide() -> str:
    """All codes: as a Markdown table those with work for an operator, in a sentence those without.

    Raises:
        TypeError: an entry is of no error, or a fault of the server's has none.
    """
    known = {error.code: status for error, status in HTTP_STATUS.items()}
    lost = set(OPERATOR) - set(known) | {code for code, status in known.items() if status >= 500} - set(OPERATOR)
    if lost:
        raise TypeError(f"these codes have no entry in the guide, or there is no error of theirs: {sorted(lost)}")
    rows = [f"| `{code}` | {known[code]} | {OPERATOR[code]} |" for code in sorted(OPERATOR)]
    others = ", ".join(f"`{code}` ({known[code]})" for code in sorted(set(known) - set(OPERATOR)))
    return "\n".join([HEADER, *rows, "", f"{SENDER}{others}."])


if __name__ == "__main__":
    print(failure_guide())
