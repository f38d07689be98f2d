//! References: a ring without checks, loans or sleeping flags. Four slots each way, a count for each, a futex wake for every
//! message or none at all. What it leaves out is what it is the measure of.

use std::{
    os::fd::{AsRawFd, FromRawFd, OwnedFd},
    sync::atomic::{AtomicU32, Ordering},
};

use memmap2::{MmapOptions, MmapRaw};
use rustix::{
    fs::{MemfdFlags, ftruncate, memfd_create},
    thread::futex::{self, Flags},
};
use sinew_figures::Figures;

use crate::pace::Pace;

const SLOTS: usize = 4;
const COUNT_BYTES: usize = 128;

/// Memory for both directions, which the echo inherits.
pub(crate) fn memory(bytes: usize) -> OwnedFd {
    let memory = memfd_create("bare-ring", MemfdFlags::empty()).expect("a memfd");
    ftruncate(&memory, 2 * (COUNT_BYTES + SLOTS * bytes) as u64).expect("a size");
    memory
}

pub(crate) fn number(memory: &OwnedFd) -> i32 {
    memory.as_raw_fd()
}

pub(crate) fn measure(memory: &OwnedFd, polls: bool, bytes: usize, pace: Pace) -> Figures {
    let map = MmapOptions::new().populate().map_raw(memory).expect("a mapping");
    let (mut there, mut back) =
        (Direction::new(&map, 0, polls, bytes), Direction::new(&map, 1, polls, bytes));
    let mut buffer = vec![7; bytes];
    pace.time(|| {
        there.send(&buffer);
        back.receive(&mut buffer);
    })
}

/// Until the measuring end ends this process.
pub(crate) fn echo(memory: usize, polls: bool, bytes: usize) {
    let number = i32::try_from(memory).expect("a descriptor");
    // SAFETY: the process that started this one left the descriptor open, and nothing else here uses it.
    let memory = unsafe { OwnedFd::from_raw_fd(number) };
    let map = MmapOptions::new().populate().map_raw(&memory).expect("a mapping");
    let (mut there, mut back) =
        (Direction::new(&map, 0, polls, bytes), Direction::new(&map, 1, polls, bytes));
    let mut buffer = vec![0; bytes];
    loop {
        there.receive(&mut buffer);
        back.send(&buffer);
    }
}

struct Direction<'a> {
    count: &'a AtomicU32,
    slots: *mut u8,
    bytes: usize,
    done: u32,
    polls: bool,
}

impl<'a> Direction<'a> {
    fn new(map: &'a MmapRaw, index: usize, polls: bool, bytes: usize) -> Self {
        let start = map.as_mut_ptr().wrapping_add(index * (COUNT_BYTES + SLOTS * bytes));
        // SAFETY: the memory is mapped as long as `map`, the address is a multiple of 8, all access is atomic.
        let count = unsafe { AtomicU32::from_ptr(start.cast()) };
        Self { count, slots: start.wrapping_add(COUNT_BYTES), bytes, done: 0, polls }
    }

    fn slot(&self) -> *mut u8 {
        self.slots.wrapping_add(self.done as usize % SLOTS * self.bytes)
    }

    fn send(&mut self, payload: &[u8]) {
        // SAFETY: a slot has as many bytes as every payload; the reader waits for the count.
        unsafe { self.slot().copy_from_nonoverlapping(payload.as_ptr(), self.bytes) };
        self.done = self.done.wrapping_add(1);
        self.count.store(self.done, Ordering::Release);
        if !self.polls {
            let _ = futex::wake(self.count, Flags::empty(), 1);
        }
    }

    fn receive(&mut self, payload: &mut [u8]) {
        while self.count.load(Ordering::Acquire) == self.done {
            if self.polls {
                std::hint::spin_loop();
            } else {
                let _ = futex::wait(self.count, Flags::empty(), self.done, None);
            }
        }
        // SAFETY: a slot has as many bytes as every payload; the writer waits for the answer.
        unsafe { self.slot().copy_to_nonoverlapping(payload.as_mut_ptr(), self.bytes) };
        self.done = self.done.wrapping_add(1);
    }
}
