//! What happens to the connections between nodes that are processes of this host: cut, stormed, unheard, not kept up with, their keys revoked.
//! One binary, one module a theme.

mod faults;
mod keys;
mod last_words;
mod lost_words;
mod slow_consumer;
mod storm;
mod unheard;
