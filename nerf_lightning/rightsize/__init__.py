"""The smallest model that is good enough: a ladder of sizes, climbed while it pays; trainings in full confirm the choice."""
