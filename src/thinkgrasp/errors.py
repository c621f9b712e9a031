"""All exceptions of the package, in one tree.

    ThinkGraspError
    ├── InputError             a file, frame, camera or instruction that cannot be used
    ├── ConfigError            a setting, preset or plug-in that cannot be used
    │   ├── PluginNotFound     no plug-in of that kind and name
    │   └── MissingDependency  an optional package is not installed
    ├── ContractError          a plug-in returned something that its interface does not allow
    └── ServerError            a ThinkGrasp server cannot be reached, is busy for too long, or failed

Expected outcomes (nothing found, no grasp survived) are values, never exceptions. The command line turns every
exception of this tree into one line on stderr and exit code 2.
"""


class ThinkGraspError(Exception):
    """Base of everything this package raises on purpose."""


class InputError(ThinkGraspError):
    """A file, frame, camera or instruction cannot be used."""


class ConfigError(ThinkGraspError):
    """A setting, preset or plug-in name cannot be used."""


class PluginNotFound(ConfigError):
    """No plug-in of that kind and name is installed."""


class MissingDependency(ConfigError):
    """An optional package is needed and not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed; "
            f"install it with: pip install 'thinkgrasp[{extra}]'"
        )


class ContractError(ThinkGraspError):
    """A plug-in returned something that its interface does not allow."""


class ServerError(ThinkGraspError):
    """A ThinkGrasp server cannot be reached, is busy for too long, or failed."""
