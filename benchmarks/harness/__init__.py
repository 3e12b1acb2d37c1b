"""Jobs that are done once and kept, and the tables, plots and pages made of them."""
