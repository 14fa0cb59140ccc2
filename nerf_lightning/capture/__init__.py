"""Photos -> scene: tags, lens, cameras, undistortion, packing."""
