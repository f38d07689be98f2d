//! Connections between nodes that are processes of this host: cut, flooded, without datagrams, too fast for a
//! consumer, with revoked keys.

mod cut;
mod faults;
mod keys;
mod last_words;
mod lost_words;
mod slow_consumer;
mod storm;
mod unheard;
