//! Limits that several layers share. A protocol fixes each of them.

/// Maximum number of GNCL addresses of a node besides the first: with the longest names an answer of NDL has 400 bytes.
pub const FURTHER_MAX: usize = 7;

/// Maximum number of NDL addresses of a node, each on a path of its own.
pub const PATHS_MAX: usize = 8;

/// Maximum length of an application's name in bytes.
pub const NAME_BYTES_MAX: usize = 63;

/// Maximum number of queued events per layer. A layer that falls this far behind has a fault of its own.
pub const EVENT_QUEUE_CAPACITY: usize = 8_192;
