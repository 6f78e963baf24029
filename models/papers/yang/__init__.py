"""Yang and Kim, cited as Y (equation): volumetric models with 21 errors and with six parameters, and the reading of a ball-bar."""
