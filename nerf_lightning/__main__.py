"""python -m nerf_lightning: the same as the command nerf_lightning."""

from nerf_lightning.cli.app import main

if __name__ == "__main__":
    main()
