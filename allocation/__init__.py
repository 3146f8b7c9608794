"""Control allocation: from a demanded force and moment to the commands of jets and surfaces, with what remains unmet."""

__all__: list[str] = []
