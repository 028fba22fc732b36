"""Scenes that the paper's authors published, where the checkout has them beside it."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "scenarios" / "published"


def published_scenarios() -> list[Path]:
    """Paths of the published scenes; none where they are not there."""
    return sorted(FOLDER.glob("*.json"))
