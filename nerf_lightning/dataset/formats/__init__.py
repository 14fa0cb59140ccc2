"""Each file format that scenes and photos come in, and what is asked of a file before it is believed."""
