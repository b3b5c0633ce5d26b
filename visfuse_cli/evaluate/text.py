"""An evaluation for people: counts, a table of errors, verdicts, identities."""

from __future__ import annotations

from typing import Any

COUNTS = ("true_states", "matched", "missed", "false", "switches", "fragments")
ERRORS = {
    "position_m": "position (m)",
    "velocity_m_s": "velocity (m/s)",
    "speed_m_s": "speed (m/s)",
    "mean_speed_m_s": "mean speed of tracks (m/s)",
}
VERDICTS = {
    "consistency": "innovations (NIS)",
    "nees": "positions (NEES)",
    "nees_with_velocity": "with velocities (NEES)",
}
SCORES = ("moda", "mota", "idf1", "hota")


def text(found: dict[str, Any]) -> str:
    """The evaluation as lines for the terminal."""
    lines = []
    if "true_states" in found:
        lines += [f"gate {found['gate_m']:g} m, {found['dimensions']} dimensions", ""]
        lines += [", ".join(f"{found[name]} {name.replace('_', ' ')}" for name in COUNTS)]
        lines += [", ".join(f"{name.upper()} {found[name]:.3f}" for name in SCORES if name in found)]
        lines += [found["identities"]] if "identities" in found else []
    if "position_m" in found:
        lines += ["", f"{'':<28}{'RMSE':>9}{'median':>9}{'max':>9}{'in 95 %':>9}   bias"]
        lines += [_error(title, found[name], found) for name, title in ERRORS.items() if name in found]
    lines += [""] if lines else []
    lines += [_verdict(title, found.get(name)) for name, title in VERDICTS.items() if name in found]
    if "speeds" in found:
        lines += ["", *_agreement(found["speeds"])]
    return "\n".join(lines)


def _error(title: str, errors: dict[str, Any], found: dict[str, Any]) -> str:
    inside = found.get("speed_interval_coverage") if title.startswith("speed") else errors.get("coverage_95")
    bias = errors["bias"] if isinstance(errors["bias"], list) else [errors["bias"]]
    shown = f"{inside:9.1%}" if inside is not None else f"{'-':>9}"
    figures = "".join(f"{errors[name]:9.3f}" for name in ("rmse", "median", "max"))
    return f"{title:<28}{figures}{shown}   {' '.join(f'{value:.3f}' for value in bias)}"


def _verdict(title: str, verdict: dict[str, Any] | None) -> str:
    if verdict is None:
        return f"{title:<28}not told: no track carries its innovations"
    low, high = verdict["band"]
    return (
        f"{title:<28}{verdict['per_degree_of_freedom']:9.3f} of 1, band {low:.3f} to {high:.3f}: {verdict['verdict']}"
    )


def _agreement(speeds: dict[str, Any]) -> list[str]:
    alone = f"{speeds['unmatched_readings']} readings and {speeds['unmatched_tracks']} tracks without"
    lines = [f"{speeds['pairs']} pairs, {alone}"]
    if "bias_kmh" in speeds:
        figures = {"bias": "bias_kmh", "mean error": "mean_error_kmh", "worst": "worst_kmh"}
        lines += [", ".join(f"{title} {speeds[name]:.2f} km/h" for title, name in figures.items())]
        lines += [f"{speeds['coverage_95']:.1%} of the 95 % intervals hold the reading"]
    if "limits_of_agreement_kmh" in speeds:
        low, high = speeds["limits_of_agreement_kmh"]
        lines += [f"limits of agreement {low:.2f} to {high:.2f} km/h"]
    return lines
