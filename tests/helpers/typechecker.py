"""The type checker that tests run the whole package under: shapes by jaxtyping, the rest by beartype."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # whole numbers are fine where floats are asked for
