"""Stage 2: joint adjustment of cameras and marker corners."""
