"""``metrics.json``: what a scored run says about itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gridreg.training.metrics import json_ready, mean_metrics
from gridreg.training.versions import versions

CONVENTIONS = {
    "psnr": "dB; mean over images of -10 log10(MSE), images in [0, 1] after clamping",
    "ssim_gaussian": "11x11 Gaussian window, sigma 1.5, population covariance (TensoRF and most)",
    "ssim_uniform": "7x7 uniform window, sample covariance (FreeNeRF, scikit-image's default)",
}
"""What each metric in ``metrics.json`` means."""


def metrics_record(
    views: Mapping[str, Mapping[str, float]],
    *,
    scene: str,
    protocol: str,
    builtin: bool,
    seed: int,
    steps: int,
    seconds: Mapping[str, float],
    config: Mapping[str, Any],
    command: Sequence[str] = (),
    train_views: Sequence[str] = (),
    conventions: Mapping[str, str] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """The content of ``metrics.json``: scores of each view and their mean, and all it takes to judge them.

    Args:
        views: metrics by name of the test view.
        scene: name of the scene.
        protocol: name of the protocol.
        builtin: whether the scene is the project's own. Then ``"benchmark"`` is false and the scene's name
            says so, because its figures must not stand beside published ones.
        seed: of the run.
        steps: iterations done.
        seconds: by phase, such as ``train`` and ``test``.
        config: the configuration, plain data.
        command: the command line.
        train_views: names of the training views.
        conventions: what further metrics mean, beside ``CONVENTIONS`` (for LPIPS: network and input range).
        more: further plain data.

    Raises:
        InputError: if there is no view, or the views do not have the same metrics.
    """
    mean = mean_metrics(list(views.values()))
    known = {**CONVENTIONS, **(conventions or {})}
    record = {
        "scene": f"{scene} (built-in, no benchmark)" if builtin else scene,
        "builtin": builtin,
        "benchmark": not builtin,
        "protocol": protocol,
        "mean": mean,
        "images": {name: dict(values) for name, values in views.items()},
        "conventions": {name: known[name] for name in mean if name in known},
        "train_views": list(train_views),
        "test_views": len(views),
        "steps": steps,
        "seed": seed,
        "seconds": dict(seconds),
        "command": list(command),
        "config": dict(config),
        "versions": versions(),
        **more,
    }
    ready: dict[str, Any] = json_ready(record)
    return ready


def summary(record: Mapping[str, Any]) -> str:
    """The mean of ``metrics_record`` in one line, with what it is the mean of."""
    mean = record["mean"]
    views = record["test_views"]
    known = record.get("trained_on")
    return (
        f"{record['scene']}, {record['protocol']}: mean of {views} test view{'s' if views != 1 else ''}"
        f"{f' ({known} of them trained on)' if known else ''}: "
        f"PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim_gaussian']:.4f} (11x11 Gaussian)"
    )
