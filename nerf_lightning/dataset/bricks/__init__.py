"""The built-in scene: a model of bricks, traced ray by ray."""
