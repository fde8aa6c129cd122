//! Keeps every frame in a pcapng file.
