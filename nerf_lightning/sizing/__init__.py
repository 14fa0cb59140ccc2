"""The smallest model that is good enough: a ladder of sizes, climbed while it pays; full trainings confirm the choice."""
