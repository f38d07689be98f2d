//! Nodes that are processes of this host or of several hosts, with the links between them. One binary, which
//! is linked once; one module for each theme.

mod attacks;
mod links;
mod networks;
