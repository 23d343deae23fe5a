"""Backup of the database and the storage as one folder, and its restore into empty ones.

The rows are kept as JSON, read in one snapshot: the same for both kinds of database, without a program of the
server's version, and restorable into the other kind. The job engine's tables are left out: they change with its
releases, and all they hold that matters is which jobs and exports have not ended. These are queued anew.
"""

from specimap_infra.backup.create import create_backup
from specimap_infra.backup.manifest import Manifest, read_manifest
from specimap_infra.backup.restore import check_backup, restore_backup

__all__ = ["Manifest", "check_backup", "create_backup", "read_manifest", "restore_backup"]
