//! The roles of users whom only the access list lets in: a guest, which does one thing to its node as often as it can, and a visitor, which is
//! a member of as many groups as it may.

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
    super::{say, told},
    stranger::{Frame, Said, Stranger},
};

payload!("guest.registration" => struct Registration { name: String });
payload!("guest.membership" => struct Membership { group: u32, member: bool });

/// Its user and its group; no account needs to have that number.
pub(crate) const GUEST: u32 = 54_321;
/// The group that the access list grants it.
pub(crate) const GRANTED: &str = "guest.news";
/// Further users, whom the access list grants all groups. Two of them may be in as many together as are in a node's list (1,024): if that had
/// those of the lowest addresses, whoever they are of, it would have none of the robot's own.
pub(crate) const VISITORS: [u32; 2] = [54_322, 54_323];

/// Its clients at once at most: those that one process may have by default.
const CLIENTS_MAX: usize = 64;
/// Groups of one client at most, as LNCL has it.
const GROUPS_MAX: u32 = 256;
/// Clients of a visitor, each of which asks for as many groups as one client may have: two have all that is a user's share (512).
const VISITING: u32 = 3;
/// The lowest address of a group: a node whose list has no room for all its groups names those first.
const LOWEST_GROUP: u32 = 0xF000_0000;
/// Frames that a client writes in one go. An even number: whoever joined has left at the end of them.
const BATCH: u32 = 32;
/// Bytes of what it says to all.
const WORD_BYTES: usize = 1_000;
/// Barriers at which one application may wait at once.
const WAITS_MAX: u32 = 16;
/// Until it tries to have one client more, when it was refused.
const AGAIN: Duration = Duration::from_millis(20);
/// Time for the answers to what it asks about groups: the node lets others have their turn in between.
const PATIENCE: Duration = Duration::from_secs(5);
/// Who waits for nothing has the CPU that is left.
const NICEST: i32 = 19;

/// What it came to.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    /// Clients at once; of those that go again at once, all.
    clients: u64,
    /// How often it did what it does.
    done: u64,
    /// Groups that it was let into, of those that its list does not grant.
    granted: u64,
    /// Connections that were refused, or ended by the node.
    refused: u64,
    /// Arrivals at barriers that the node refused because they were beyond its share, by the answers that came.
    beyond: u64,
}

/// `SOCKET WHAT MILLISECONDS`: becomes the guest, and does that. Tells what it came to at its end: `CLIENTS DONE GRANTED REFUSED BEYOND`.
pub(in crate::clients) fn play(arguments: &[String]) {
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
    say(&format!("{clients} {done} {granted} {refused} {beyond}"));
}

/// `SOCKET NUMBER`: becomes that one of the visitors, and asks for more groups at the lowest addresses than it may have. Tells how many it is
/// in, and stays there until it is told to end.
pub(in crate::clients) fn play_visitor(arguments: &[String]) {
    let [socket, number] = arguments else { panic!("a socket and a number, not {arguments:?}") };
    let number: u32 = number.parse().expect("a number");
    become_user(VISITORS[number as usize]);
    let (mut clients, mut granted) = (Vec::new(), 0);
    for client in 0..VISITING {
        let lowest = LOWEST_GROUP + (number * VISITING + client) * GROUPS_MAX;
        // Who does not come in is in fewer groups, which is told.
        let Ok(Some(mut visitor)) = Client::register(Path::new(socket), "visitor", client) else { break };
        granted += visitor.join(lowest..lowest + GROUPS_MAX).unwrap_or_default();
        clients.push(visitor);
    }
    say(&granted);
    told().for_each(drop);
}

/// While there is one thread: each has a user of its own, as the kernel sees it, and takes over that of who starts it.
fn become_user(user: u32) {
    // It goes on as it is where the system refuses it.
    let _ = setpriority_process(None, NICEST);
    set_thread_gid(Gid::from_raw(user)).expect("its director is root");
    set_thread_uid(Uid::from_raw(user)).expect("its director is root");
}

/// One connection, and what is on its way to the node.
struct Client {
    stranger: Stranger,
    name: String,
    bytes: Vec<u8>,
    written: usize,
    /// How much is done when these are written.
    counts: u32,
    /// What of the node's next frame has come.
    unread: Vec<u8>,
    /// Arrivals beyond its share, by the answers.
    beyond: u64,
}

/// What a client writes next, and how much that counts; nothing: it has done what it does.
type Next<'a> = &'a mut dyn FnMut(Tid, &str) -> (Vec<u8>, u32);

impl Client {
    /// `None` if the node has no place for it, or lets it come later only.
    fn register(socket: &Path, role: &str, number: u32) -> io::Result<Option<Self>> {
        let name = format!("{role}.{}.{number}", std::process::id());
        let mut stranger = Stranger::connect(socket)?;
        let wishes = Registration { name: name.clone() };
        stranger.write(&Frame::of_lncl(Kind::LNCL_REGISTER, Tid::NONE, &wishes).bytes())?;
        let Some(said) = stranger.read()? else { return Ok(None) };
        if said.kind != Kind::LNCL_REGISTERED {
            return Ok(None);
        }
        stranger.tid = Tid::from_bits(said.source);
        let (bytes, unread) = (Vec::new(), Vec::new());
        Ok(Some(Self { stranger, name, bytes, written: 0, counts: 0, unread, beyond: 0 }))
    }

    /// Asks to be a member of these, and waits for the answers: how many said yes.
    fn join(&mut self, groups: impl Iterator<Item = u32>) -> io::Result<u64> {
        let lncl = Tid::new(NodeAddress::HERE, AppAddress::LNCL);
        let (mut bytes, mut asked) = (Vec::new(), 0);
        for group in groups {
            let mut header = Header::new(Kind::LNCL_GROUP, self.stranger.tid, lncl);
            asked += 1;
            (header.flags, header.correlation) = (Flags::CONFIRM, asked);
            bytes.extend(Frame::new(&header, encode(&Membership { group, member: true }).to_vec()).bytes());
        }
        self.stranger.stream.set_read_timeout(Some(PATIENCE))?;
        self.stranger.write(&bytes)?;
        let mut granted = 0;
        for _ in 0..asked {
            let said = self.stranger.read()?.ok_or(io::ErrorKind::UnexpectedEof)?;
            // Delivered.
            granted += u64::from(said.kind == Kind::OUTCOME && said.payload == [0]);
        }
        Ok(granted)
    }

    /// Writes as much as the socket takes at once, and reads what the node says. Returns how much is done by that.
    fn go_on(&mut self, next: Next<'_>) -> io::Result<u32> {
        self.listen()?;
        if self.written == self.bytes.len() {
            (self.bytes, self.counts) = next(self.stranger.tid, &self.name);
            self.written = 0;
        }
        if self.bytes.is_empty() {
            return Ok(0);
        }
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        match send(&self.stranger.stream, &self.bytes[self.written..], flags) {
            Ok(count) => self.written += count,
            Err(Errno::AGAIN) => {}
            Err(error) => return Err(error.into()),
        }
        Ok(if self.written == self.bytes.len() { self.counts } else { 0 })
    }

    /// Counts what was beyond its share, and throws away what else has come.
    fn listen(&mut self) -> io::Result<()> {
        let mut bytes = [0_u8; 16 << 10];
        loop {
            match recv(&self.stranger.stream, &mut bytes[..], RecvFlags::DONTWAIT) {
                Ok((_, 0)) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok((_, count)) => self.unread.extend_from_slice(&bytes[..count]),
                Err(Errno::AGAIN) => return Ok(()),
                Err(error) => return Err(error.into()),
            }
            let mut read = 0;
            while let Some((said, length)) = Said::first_of(&self.unread[read..]) {
                self.beyond += u64::from(is_beyond_share(&said));
                read += length;
            }
            self.unread.drain(..read);
        }
    }
}

/// Whether an arrival was refused for what users that are not the node's own may have, of which all such answers speak.
fn is_beyond_share(said: &Said) -> bool {
    said.kind == BarrierAnswer::KIND
        && matches!(decode(&said.payload), Ok(BarrierAnswer::Refused { why }) if why.contains("other user"))
}

struct Guest {
    socket: PathBuf,
    end: Instant,
    /// Names that it has asked for.
    names: u32,
    tally: Tally,
}

impl Guest {
    /// Joins the group that it may be in, and some that it may not, and leaves them again.
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

    /// Is a member of as many groups as it is let, at the lowest addresses that there are.
    fn fill_groups(&mut self) {
        self.crowd(
            |client, number| {
                let lowest = LOWEST_GROUP + number % CLIENTS_MAX as u32 * GROUPS_MAX;
                (u64::from(GROUPS_MAX), client.join(lowest..lowest + GROUPS_MAX))
            },
            &mut |_, _| (Vec::new(), 0),
        );
    }

    /// Arrives at one barrier after the other, each of another name, and waits at none of them for more than a millisecond.
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

    /// Sends what nobody knows to each application of each node.
    fn say_to_all(&mut self) {
        self.crowd(|_, _| (0, Ok(0)), &mut |tid, _| {
            let header = Header::new(Kind::named("guest.word"), tid, Tid::BROADCAST);
            let frame = |_| Frame::new(&header, vec![7; WORD_BYTES]).bytes();
            ((0..BATCH).flat_map(frame).collect(), BATCH)
        });
    }

    /// Connects and closes, and beside that registers and leaves.
    fn come_and_go(&mut self) {
        let (socket, end) = (self.socket.clone(), self.end);
        // Before all that it may is used up by who only connects.
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

    /// Has as many clients as the node lets it. Each does at first one thing, which says how much of it was done and how much granted, and then
    /// what is next, again and again.
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
