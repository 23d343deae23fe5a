"""All settings of the service and its workers, from the environment and a file, read when a program starts."""

from specimap_infra.settings.service import (
    CONFIG_VARIABLE,
    OTHER_VARIABLES,
    ServiceSettings,
    known_variables,
    load_settings,
)
from specimap_infra.settings.units import GIB, MIB

__all__ = ["CONFIG_VARIABLE", "GIB", "MIB", "OTHER_VARIABLES", "ServiceSettings", "known_variables", "load_settings"]
