"""What moves before a moving stereo camera: found by its flow, followed by several motion models, settled."""
