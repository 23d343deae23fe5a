"""Processes that read files from outside reach nothing but those files: Landlock, seccomp, no capabilities.

A file may hold more than its reader expects: a link to another file, or bytes that take a decoder over. So whatever
reads such files does it in a process that has given up, before it loads a library, all but what the task needs. Only
the standard library is imported here.
"""

from specimap_core.sandbox.launch import Confinement, Protection, confined, hide_from_others, protection
from specimap_core.sandbox.places import MODES, Mode, Reach, program_rules

__all__ = [
    "MODES",
    "Confinement",
    "Mode",
    "Protection",
    "Reach",
    "confined",
    "hide_from_others",
    "program_rules",
    "protection",
]
