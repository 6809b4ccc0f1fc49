"""What the pages of results conclude, each sentence with what raw results must be for it."""
