"""Control of a scene: measured points, and matches with reference orthoimages."""
