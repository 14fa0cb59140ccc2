"""Videos and images of a trained run: a camera path, a frame for each of its views, a file of them."""
