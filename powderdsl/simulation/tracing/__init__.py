"""Why a cell holds what it holds: every write of a step, what its rule read, and which rules nearly happened."""
