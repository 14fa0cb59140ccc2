"""Model size search: a growing training climbs a ladder of sizes; full trainings confirm the choice."""
