//! The roles of users that only the access list admits. A guest does one thing to its node as often as it
//! can. A visitor is a member of as many groups as it may be.

use std::{
    io,
    os::unix::net::UnixStream,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use rustix::{
    io::Errno,
    net::{RecvFlags, SendFlags, recv, send},
    process::{Gid, Uid, setpriority_process},
    thread::{set_thread_gid, set_thread_uid},
};
use sinew::{
    AppAddress, NodeAddress, Payload as _, Tid,
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, OnPartyLoss},
    message::Kind,
    payload,
};
use sinew_runtime::wire::{Flags, Header, decode, encode};

use super::{
    super::{commands, print_line},
    raw_connection::{Frame, NodeFrame, RawConnection},
};

payload!("guest.registration" => struct Registration { name: String });
payload!("guest.membership" => struct Membership { group: u32, member: bool });

/// User id and group id of the guest; no account needs to have this number.
pub(crate) const GUEST: u32 = 54_321;
/// The group that the access list grants it.
pub(crate) const GRANTED: &str = "guest.news";
/// Further users, to which the access list grants all groups. Two of them together may fill a node's group
/// list (1,024). If that list kept the lowest addresses regardless of their owners, it would have no room for
/// the robot's own groups.
pub(crate) const VISITORS: [u32; 2] = [54_322, 54_323];

/// Maximum number of its concurrent clients: the default limit per process.
const CLIENTS_MAX: usize = 64;
/// Maximum number of groups of one client, as LNCL defines it.
const GROUPS_MAX: u32 = 256;
/// Number of clients of a visitor. Each requests as many groups as one client may have; two of them use up
/// the user's share (512).
const VISITING: u32 = 3;
/// The lowest group address: a node with a full list announces the lowest addresses first.
const LOWEST_GROUP: u32 = 0xF000_0000;
/// Frames that a client writes in one go. The number is even, so that each join is followed by its leave.
const BATCH: u32 = 32;
/// Length of a message to all, in bytes.
const WORD_BYTES: usize = 1_000;
/// Maximum number of barriers at which one application may wait at the same time.
const WAITS_MAX: u32 = 16;
/// Delay before another client is tried after a refusal.
const AGAIN: Duration = Duration::from_millis(20);
/// Timeout of the answers about groups: the node lets others have their turn in between.
const READ_TIMEOUT: Duration = Duration::from_secs(5);
/// Lowest priority: a client that never waits gets only the CPU time that is left.
const NICEST: i32 = 19;

/// The counters.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    /// Concurrent clients; if clients leave at once, their total number.
    clients: u64,
    /// Number of actions.
    done: u64,
    /// Groups that it was admitted to but its list does not grant.
    granted: u64,
    /// Connections that the node refused or closed.
    refused: u64,
    /// Arrivals at barriers that the node rejected because they exceeded the share, according to the answers.
    beyond: u64,
}

/// `SOCKET WHAT MILLISECONDS`: becomes the guest, and does this. Prints its counters at its end: `CLIENTS
/// DONE GRANTED REFUSED BEYOND`.
pub(in crate::clients) fn run(arguments: &[String]) {
    let [socket, what, lasts] = arguments else { panic!("a socket, what, and how long, not {arguments:?}") };
    become_user(GUEST);
    let lasts = Duration::from_millis(lasts.parse().expect("a number"));
    let mut guest = Guest {
        socket: PathBuf::from(socket),
        end: Instant::now() + lasts,
        names: 0,
        tally: Tally::default(),
    };
    match &**what {
        "groups" => guest.toggle_groups(),
        "memberships" => guest.fill_groups(),
        "barriers" => guest.arrive_everywhere(),
        "messages" => guest.say_to_all(),
        "connections" => guest.come_and_go(),
        _ => panic!("{what:?} is nothing that a guest does"),
    }
    let Tally { clients, done, granted, refused, beyond } = guest.tally;
    print_line(&format!("{clients} {done} {granted} {refused} {beyond}"));
}

/// `SOCKET NUMBER`: becomes this visitor, and requests more groups at the lowest addresses than it may have.
/// Prints the number of groups that it is in, and stays a member until it is asked to end.
pub(in crate::clients) fn run_visitor(arguments: &[String]) {
    let [socket, number] = arguments else { panic!("a socket and a number, not {arguments:?}") };
    let number: u32 = number.parse().expect("a number");
    become_user(VISITORS[number as usize]);
    let (mut clients, mut granted) = (Vec::new(), 0);
    for client in 0..VISITING {
        let lowest = LOWEST_GROUP + (number * VISITING + client) * GROUPS_MAX;
        // A client that is not admitted lowers the number of groups, which is printed.
        let Ok(Some(mut visitor)) = Client::register(Path::new(socket), "visitor", client) else { break };
        granted += visitor.join(lowest..lowest + GROUPS_MAX).unwrap_or_default();
        clients.push(visitor);
    }
    print_line(&granted);
    commands().for_each(drop);
}

/// Must run while there is only one thread: for the kernel each thread has its own user, inherited from its
/// creator.
fn become_user(user: u32) {
    // If the system refuses, the priority stays as it is.
    let _ = setpriority_process(None, NICEST);
    set_thread_gid(Gid::from_raw(user)).expect("its scenario is root");
    set_thread_uid(Uid::from_raw(user)).expect("its scenario is root");
}

/// A connection, and the bytes not yet written to the node.
struct Client {
    connection: RawConnection,
    name: String,
    bytes: Vec<u8>,
    written: usize,
    /// Number of actions that count once these bytes are written.
    counts: u32,
    /// The received part of the node's next frame.
    unread: Vec<u8>,
    /// Rejected arrivals beyond its share, according to the answers.
    beyond: u64,
}

/// Returns the next bytes of a client, and the number of actions in them; empty: the client has finished.
type Next<'a> = &'a mut dyn FnMut(Tid, &str) -> (Vec<u8>, u32);

impl Client {
    /// `None` if the node has no free slot for it, or asks it to return later.
    fn register(socket: &Path, role: &str, number: u32) -> io::Result<Option<Self>> {
        let name = format!("{role}.{}.{number}", std::process::id());
        let mut connection = RawConnection::connect(socket)?;
        let wishes = Registration { name: name.clone() };
        connection.write(&Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes).bytes())?;
        let Some(answer) = connection.read()? else { return Ok(None) };
        if answer.kind != Kind::LNCL_REGISTERED {
            return Ok(None);
        }
        connection.tid = Tid::from_bits(answer.source);
        let (bytes, unread) = (Vec::new(), Vec::new());
        Ok(Some(Self { connection, name, bytes, written: 0, counts: 0, unread, beyond: 0 }))
    }

    /// Requests membership in these groups, and waits for the answers. Returns how many were granted.
    fn join(&mut self, groups: impl Iterator<Item = u32>) -> io::Result<u64> {
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        let (mut bytes, mut asked) = (Vec::new(), 0);
        for group in groups {
            let mut header = Header::new(Kind::LNCL_GROUP, self.connection.tid, lncl);
            asked += 1;
            (header.flags, header.correlation) = (Flags::CONFIRM, asked);
            bytes.extend(Frame::new(&header, encode(&Membership { group, member: true }).to_vec()).bytes());
        }
        self.connection.stream.set_read_timeout(Some(READ_TIMEOUT))?;
        self.connection.write(&bytes)?;
        let mut granted = 0;
        for _ in 0..asked {
            let answer = self.connection.read()?.ok_or(io::ErrorKind::UnexpectedEof)?;
            // Delivered.
            granted += u64::from(answer.kind == Kind::OUTCOME && answer.payload == [0]);
        }
        Ok(granted)
    }

    /// Writes as much as the socket accepts, and reads from the node. Returns the number of completed
    /// actions.
    fn go_on(&mut self, next: Next<'_>) -> io::Result<u32> {
        self.listen()?;
        if self.written == self.bytes.len() {
            (self.bytes, self.counts) = next(self.connection.tid, &self.name);
            self.written = 0;
        }
        if self.bytes.is_empty() {
            return Ok(0);
        }
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        match send(&self.connection.stream, &self.bytes[self.written..], flags) {
            Ok(count) => self.written += count,
            Err(Errno::AGAIN) => {}
            Err(error) => return Err(error.into()),
        }
        Ok(if self.written == self.bytes.len() { self.counts } else { 0 })
    }

    /// Counts rejections beyond its share, and discards everything else that has arrived.
    fn listen(&mut self) -> io::Result<()> {
        let mut bytes = [0_u8; 16 << 10];
        loop {
            match recv(&self.connection.stream, &mut bytes[..], RecvFlags::DONTWAIT) {
                Ok((_, 0)) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok((_, count)) => self.unread.extend_from_slice(&bytes[..count]),
                Err(Errno::AGAIN) => return Ok(()),
                Err(error) => return Err(error.into()),
            }
            let mut read = 0;
            while let Some((frame, length)) = NodeFrame::first_of(&self.unread[read..]) {
                self.beyond += u64::from(is_beyond_share(&frame));
                read += length;
            }
            self.unread.drain(..read);
        }
    }
}

/// Returns whether an arrival was rejected because of the share of foreign users, which all such answers
/// mention.
fn is_beyond_share(frame: &NodeFrame) -> bool {
    frame.kind == BarrierAnswer::KIND
        && matches!(decode(&frame.payload), Ok(BarrierAnswer::Refused { why }) if why.contains("other user"))
}

struct Guest {
    socket: PathBuf,
    end: Instant,
    /// Number of names requested so far.
    names: u32,
    tally: Tally,
}

impl Guest {
    /// Joins the group that it may join and some that it may not, and leaves them again.
    fn toggle_groups(&mut self) {
        let mut turn = 0;
        self.crowd(
            |client, number| (1, client.join(std::iter::once(LOWEST_GROUP + number))),
            &mut |tid, _| {
                turn += 1;
                let other = LOWEST_GROUP + turn % GROUPS_MAX;
                let group = |step: u32| if step % 4 < 2 { AppAddress::group(GRANTED).bits() } else { other };
                let frame = |step| {
                    let membership = Membership { group: group(step), member: step % 2 == 0 };
                    Frame::of_lncl(Kind::LNCL_GROUP, tid, &membership).bytes()
                };
                ((0..BATCH).flat_map(frame).collect(), BATCH)
            },
        );
    }

    /// Joins as many groups as allowed, at the lowest addresses.
    fn fill_groups(&mut self) {
        self.crowd(
            |client, number| {
                let lowest = LOWEST_GROUP + number % CLIENTS_MAX as u32 * GROUPS_MAX;
                (u64::from(GROUPS_MAX), client.join(lowest..lowest + GROUPS_MAX))
            },
            &mut |_, _| (Vec::new(), 0),
        );
    }

    /// Arrives at one barrier after the other, each with a new name, and waits at most a millisecond at each.
    fn arrive_everywhere(&mut self) {
        let mut barriers = 0_u64;
        self.crowd(|_, _| (0, Ok(0)), &mut |tid, name| {
            let frame = |_| {
                barriers += 1;
                let arrive = ArriveAtBarrier {
                    barrier: format!("guest.{barriers}"),
                    parties: vec![name.to_owned(), "nobody".to_owned()],
                    within_ms: 1,
                    on_loss: OnPartyLoss::Wait,
                    kind: BarrierKind::Meeting,
                };
                let sync = Tid::new(NodeAddress::HERE, AppAddress::SYNC);
                let mut header = Header::new(ArriveAtBarrier::KIND, tid, sync);
                (header.flags, header.correlation) = (Flags::ASK, barriers);
                Frame::new(&header, encode(&arrive).to_vec()).bytes()
            };
            ((0..WAITS_MAX).flat_map(frame).collect(), WAITS_MAX)
        });
    }

    /// Sends messages of an unknown kind to each application of each node.
    fn say_to_all(&mut self) {
        self.crowd(|_, _| (0, Ok(0)), &mut |tid, _| {
            let header = Header::new(Kind::named("guest.word"), tid, Tid::BROADCAST);
            let frame = |_| Frame::new(&header, vec![7; WORD_BYTES]).bytes();
            ((0..BATCH).flat_map(frame).collect(), BATCH)
        });
    }

    /// Connects and closes, and also registers and leaves.
    fn come_and_go(&mut self) {
        let (socket, end) = (self.socket.clone(), self.end);
        // Registers first, before the mere connections use up its share.
        let first = matches!(Client::register(&socket, "guest", 0), Ok(Some(_)));
        let registering = thread::spawn(move || {
            let mut tally = Tally::default();
            for number in (1..).take_while(|_| Instant::now() < end) {
                tally.done += 1;
                match Client::register(&socket, "guest", number) {
                    Ok(Some(_)) => tally.clients += 1,
                    Ok(None) | Err(_) => tally.refused += 1,
                }
            }
            tally
        });
        let mut closed = 0;
        while Instant::now() < self.end {
            closed += u64::from(UnixStream::connect(&self.socket).is_ok());
        }
        self.tally = registering.join().expect("it only tries");
        self.tally.clients += u64::from(first);
        self.tally.done += closed + 1;
    }

    /// Runs as many clients as the node admits. Each performs a first action, which returns the number of
    /// actions and of grants, and then repeats the next one.
    fn crowd(
        &mut self,
        mut at_first: impl FnMut(&mut Client, u32) -> (u64, io::Result<u64>),
        next: Next<'_>,
    ) {
        let mut clients: Vec<Client> = Vec::new();
        let mut tries_at = Instant::now();
        while Instant::now() < self.end {
            if clients.len() < CLIENTS_MAX && Instant::now() >= tries_at {
                self.names += 1;
                match Client::register(&self.socket, "guest", self.names) {
                    Ok(Some(mut client)) => {
                        let (done, granted) = at_first(&mut client, self.names - 1);
                        self.tally.done += done;
                        self.tally.granted += granted.as_ref().copied().unwrap_or_default();
                        self.tally.refused += u64::from(granted.is_err());
                        clients.extend(granted.is_ok().then_some(client));
                    }
                    Ok(None) | Err(_) => {
                        self.tally.refused += 1;
                        tries_at = Instant::now() + AGAIN;
                    }
                }
            }
            self.tally.clients = self.tally.clients.max(clients.len() as u64);
            let (before, done) = (clients.len(), self.tally.done);
            clients.retain_mut(|client| {
                let counts = client.go_on(&mut *next);
                self.tally.beyond += std::mem::take(&mut client.beyond);
                self.tally.done += u64::from(counts.as_ref().copied().unwrap_or_default());
                counts.is_ok()
            });
            self.tally.refused += (before - clients.len()) as u64;
            if self.tally.done == done {
                thread::sleep(Duration::from_millis(1));
            }
        }
    }
}
