"""Output for people: derived equations, figures, films, and the display of objects in notebooks."""
