"""Drawing: panels, contact sheets, frames, charts and their style."""
