"""Pages in the browser about a scene and about a trained field; they need Viser, an optional extra."""
