"""What a robot can be asked to do: for now where it reaches, and how, at rest."""
