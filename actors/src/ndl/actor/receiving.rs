//! Reading datagrams, and what of them is looked at.

use std::{io, net::SocketAddr, rc::Rc, time::Duration};

use sinew_runtime::time::Time;

use super::Shell;
use crate::{
    ndl::{
        core::{Place, Way},
        datagram::{DATAGRAM_MAX, is_frame, maker_of},
    },
    secured::SEAL_LEN,
};

/// Rest after a failed read, so that a socket that fails for good does not take the whole thread.
const READ_FAILED_REST: Duration = Duration::from_millis(10);
/// Datagrams that are read at once at most; then there is a rest, so that a flood leaves a CPU to others, whatever this thread's priority is and
/// however long each of them takes to be checked.
const AT_ONCE: u32 = 128;
/// Time after which there may be one more: whoever sends no faster has all read at once. A thousand nodes that ask each other each 50 ms do not.
const ONE_MORE: Duration = Duration::from_nanos(1_000_000 / 64);
/// As many of the project's as one that is not: of a flood 32 are read at once, and 16 in each millisecond, by a thread that all others may have
/// to wait for.
const FOREIGN_IS_WORTH: u32 = 4;
const REST: Duration = Duration::from_millis(1);

/// What is said of a datagram without a seal to a node that takes none such. Anybody can send one: never that this node is to be without keys.
const UNSEALED: &str = "it has no seal, and this node has keys; if that node is of this robot, give it keys: `sinew keys issue NAME --keys DIR`, and \
                        set security.keys there";

/// How fast datagrams are read, whatever socket they come to: one thread reads them all. Whether the next one waits when one has been read is
/// nothing to it: a flood that is a little slower than this thread would never let it rest.
#[derive(Debug)]
pub(super) struct Pace {
    read: u32,
    /// Until when time has made good for some.
    as_of: Time,
}

impl Pace {
    pub(super) const fn new(now: Time) -> Self {
        Self { read: 0, as_of: now }
    }

    /// One was read at `now`. Returns whether a rest is due.
    fn read_one(&mut self, now: Time, worth: u32) -> bool {
        self.pass_time(now);
        self.read += worth;
        self.read >= AT_ONCE
    }

    /// Whether a rest is due still: what was read of other sockets counts, too.
    fn is_due(&mut self, now: Time) -> bool {
        self.pass_time(now);
        self.read >= AT_ONCE
    }

    fn pass_time(&mut self, now: Time) {
        let more = now.since(self.as_of).as_nanos() / ONE_MORE.as_nanos();
        let more = u32::try_from(more).unwrap_or(u32::MAX);
        self.as_of = self.as_of + ONE_MORE.saturating_mul(more);
        self.read = self.read.saturating_sub(more);
    }
}

/// Reads datagrams for as long as this instance is the current one. Answers leave from here.
pub(super) async fn receive(shell: Rc<Shell>, socket: tokio::net::UdpSocket, (here, way): (SocketAddr, Way)) {
    // One byte more than is taken: a longer datagram is noticed, not cut.
    let mut buffer = [0; DATAGRAM_MAX + SEAL_LEN + 1];
    loop {
        let received = match socket.try_recv_from(&mut buffer) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => socket.recv_from(&mut buffer).await,
            received => received,
        };
        match received {
            Ok((length, there)) => {
                let bytes = shell.unsealed(there, &buffer[..length]);
                let worth = if bytes.is_some() { 1 } else { FOREIGN_IS_WORTH };
                if let Some(bytes) = bytes
                    && !shell.feed(|core, now| core.receive(now, Place { there, here }, way, bytes))
                {
                    return;
                }
                let mut is_due = shell.pace.borrow_mut().read_one(Time::now(), worth);
                while is_due {
                    tokio::time::sleep(REST).await;
                    is_due = shell.pace.borrow_mut().is_due(Time::now());
                }
            }
            Err(error) => {
                shell.refusals.count(Time::now(), "NDL socket not readable", &error);
                tokio::time::sleep(READ_FAILED_REST).await;
            }
        }
    }
}

impl Shell {
    /// What came from `from`, if this node has no keys, or a node of its project made it. spec: NDL-1.3
    fn unsealed<'a>(&self, from: SocketAddr, bytes: &'a [u8]) -> Option<&'a [u8]> {
        let Some(secured) = self.stores.secured.get() else { return Some(bytes) };
        let now = Time::now();
        let refused = |why: &&str| {
            // As a node without keys sends it, or somebody who pretends to be one.
            let why = if is_frame(bytes) { UNSEALED } else { *why };
            self.refusals.count(
                now,
                "NDL datagram not of this project's keys",
                &format_args!("{from}: {why}"),
            );
        };
        secured.unseal(now, bytes, maker_of).inspect_err(refused).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGIN: Time = Time::from_nanos(1_000_000_000);

    #[test]
    fn a_flood_has_no_more_of_the_thread_where_each_datagram_has_been_read_when_the_next_one_comes() {
        for micros in [1, 5, 20, 60] {
            let (mut pace, mut now, mut read) = (Pace::new(BEGIN), BEGIN, 0);
            let end = now + Duration::from_secs(1);
            while now < end {
                now = now + Duration::from_micros(micros);
                read += 1;
                if pace.read_one(now, FOREIGN_IS_WORTH) {
                    now = now + REST;
                }
            }
            let at_once = AT_ONCE / FOREIGN_IS_WORTH;
            assert!(read <= 16_000 + at_once, "{read} of those that come each {micros} us");
            assert!(read >= 12_000, "{read} of those that come each {micros} us");
        }
    }

    #[test]
    fn a_flood_of_several_sockets_has_no_more_of_the_thread_than_one_of_one() {
        const SOCKETS: usize = 40;
        let (mut pace, mut now, mut read) = (Pace::new(BEGIN), BEGIN, 0);
        let mut rests = [false; SOCKETS];
        let end = now + Duration::from_secs(1);
        while now < end {
            for rests in &mut rests {
                *rests = *rests && pace.is_due(now);
                while !*rests {
                    now = now + Duration::from_micros(5);
                    read += 1;
                    *rests = pace.read_one(now, FOREIGN_IS_WORTH);
                }
            }
            now = now + REST;
        }
        // At first each has waited for one already, which it reads in any case.
        let at_once = AT_ONCE / FOREIGN_IS_WORTH + SOCKETS as u32;
        assert!(read <= 16_000 + at_once, "{read}");
        assert!(read >= 12_000, "{read}");
    }

    #[test]
    fn datagrams_of_the_project_that_come_as_they_may_wait_for_no_rest() {
        // 64 nodes that ask each other each 10 ms, all at once; 640 that do each 20 ms, evenly.
        for (at_once, each) in [(2 * 63, Duration::from_millis(10)), (1, Duration::from_nanos(15_640))] {
            let (mut pace, mut now) = (Pace::new(BEGIN), BEGIN);
            for _ in 0..1_000 {
                now = now + each;
                assert!((0..at_once).all(|_| !pace.read_one(now, 1)), "{at_once} each {each:?}");
            }
        }
    }
}
