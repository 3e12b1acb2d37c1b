"""``paper``: the tables of the paper, our fields and their peers on the same clouds, measured in the same way."""
