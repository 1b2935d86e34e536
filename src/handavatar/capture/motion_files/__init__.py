"""Hand motions in the files of other programs: one module for each family of layouts."""
