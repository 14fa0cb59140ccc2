"""From a video or plain photos to photos with known cameras."""
