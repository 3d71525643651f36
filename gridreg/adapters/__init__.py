"""Ways into programs of others: each module needs the program that it is named after."""
