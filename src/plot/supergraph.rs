//! A supergraph: its slots in the order in which they run.
