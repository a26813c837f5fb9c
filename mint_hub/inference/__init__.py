"""From a video to one episode: windows, chaining, fusion, and the transformers pipeline."""
