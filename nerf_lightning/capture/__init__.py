"""Stage 0, photos -> scene: tags, lens, cameras, undistortion, packing; and synthetic captures to test them on."""
