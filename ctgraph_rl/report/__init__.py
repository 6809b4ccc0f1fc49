"""What runs look like: tables and curves on the terminal, and one page of figures and tables for any number of runs."""
