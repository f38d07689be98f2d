//! The rings of links as the ends of one wait.

use std::os::fd::AsFd;

use sinew_shm::{Consumer, Ends, HangUp};

use super::established::EstablishedLink;
use crate::link::ring::End;

/// The open links, for a wait while there is no node.
pub(super) struct LinkEnds<'a>(pub(super) &'a mut [EstablishedLink]);

impl Ends for LinkEnds<'_> {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn consumer(&self, index: usize) -> &Consumer {
        &self.0[index].consumer
    }

    fn consumer_mut(&mut self, index: usize) -> &mut Consumer {
        &mut self.0[index].consumer
    }

    fn hang_up(&self, index: usize) -> Option<HangUp<'_>> {
        Some(HangUp::Socket(self.0[index].socket.as_fd()))
    }
}

/// The node's ring and those of the open links, for one wait on all of them.
pub(crate) struct AllEnds<'a> {
    pub(crate) node: &'a mut End,
    pub(crate) links: &'a mut [EstablishedLink],
}

impl Ends for AllEnds<'_> {
    fn count(&self) -> usize {
        1 + self.links.len()
    }

    fn consumer(&self, index: usize) -> &Consumer {
        match index.checked_sub(1) {
            None => self.node.consumer(0),
            Some(index) => &self.links[index].consumer,
        }
    }

    fn consumer_mut(&mut self, index: usize) -> &mut Consumer {
        match index.checked_sub(1) {
            None => self.node.consumer_mut(0),
            Some(index) => &mut self.links[index].consumer,
        }
    }

    fn hang_up(&self, index: usize) -> Option<HangUp<'_>> {
        match index.checked_sub(1) {
            None => self.node.hang_up(0),
            Some(index) => Some(HangUp::Socket(self.links[index].socket.as_fd())),
        }
    }
}
