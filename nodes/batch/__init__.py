"""What is computed in one go from a block or a recording: adjustment results and orthoimages."""
