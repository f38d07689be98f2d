//! Which of this host's addresses are lost, because their interface went down or they were taken away: the kernel says so (rtnetlink).
//!
//! A connection does not notice it by itself: what it writes waits for an interface to come back.
//!
//! Where the kernel has said more than there was room for, some of it is not known: then all is asked for again, and what is not there any more
//! is lost as if it had been said.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt, io,
    net::{IpAddr, SocketAddr, SocketAddrV6},
    os::fd::OwnedFd,
};

use futures_util::{Stream, stream};
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, bind, netlink::SocketAddrNetlink, recv,
    send, socket_with,
};
use tokio::io::unix::AsyncFd;

/// An address that is of no use any more to those that are bound to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct AddressLost(pub(super) SocketAddr);

impl fmt::Display for AddressLost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.ip().fmt(f)
    }
}

/// Addresses that are known at most. One more is found to be lost by what is not answered, as everywhere but on Linux.
const ADDRESSES_MAX: usize = 1_024;
/// More than the kernel says at once.
const BUFFER_LEN: usize = 32 << 10;

/// Kinds of messages, and the parts of them that are looked at: `linux/rtnetlink.h`, `linux/if_link.h`, `linux/if_addr.h`.
const NEW_LINK: u16 = 16;
const GONE_LINK: u16 = 17;
const NEW_ADDRESS: u16 = 20;
const GONE_ADDRESS: u16 = 21;
const GET_LINKS: u16 = 18;
const GET_ADDRESSES: u16 = 22;
/// `NLMSG_ERROR`, `NLMSG_DONE`: `linux/netlink.h`.
const REFUSED: u16 = 2;
const DONE: u16 = 3;
const HEADER_LEN: usize = 16;
/// An interface's index is in the same place of both bodies; its flags follow it, and an address's attributes.
const INDEX_AT: usize = HEADER_LEN + 4;
const FLAGS_AT: usize = HEADER_LEN + 8;
const ATTRIBUTES_AT: usize = HEADER_LEN + 8;
/// `IFF_UP | IFF_RUNNING`: wanted up, and able to carry packets.
const UP: u32 = 0x41;
/// `IFA_LOCAL`, `IFA_ADDRESS`: where there is a peer, the second is the peer's.
const LOCAL: u16 = 2;
const ADDRESS: u16 = 1;
const IPV4: u8 = 2;
const IPV6: u8 = 10;
/// `RTMGRP_LINK | RTMGRP_IPV4_IFADDR | RTMGRP_IPV6_IFADDR`.
const GROUPS: u32 = 0x111;
/// `NLM_F_REQUEST | NLM_F_DUMP`.
const DUMP: u16 = 0x301;
/// `NLM_F_MULTI`: part of what was asked for. `NLM_F_DUMP_INTR`: something changed meanwhile.
const OF_A_DUMP: u16 = 0x2;
const IS_SPOILT: u16 = 0x10;

/// What is asked for at once; one answer is over before the next question.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asked {
    Addresses,
    /// And their state.
    Links,
}

/// All that there is, as far as the kernel has answered.
#[derive(Debug)]
struct Survey {
    asked: Asked,
    found: Interfaces,
    /// It is not the first one: interfaces may have gone down unheard.
    is_again: bool,
    /// Something was not heard meanwhile.
    is_spoilt: bool,
}

impl Survey {
    fn new(is_again: bool) -> Self {
        Self { asked: Asked::Addresses, found: Interfaces::default(), is_again, is_spoilt: false }
    }
}

/// What is known, and what is being asked for.
#[derive(Debug)]
struct Known {
    interfaces: Interfaces,
    survey: Option<Survey>,
}

impl Known {
    /// Nothing is; addresses are asked for.
    fn new() -> Self {
        Self { interfaces: Interfaces::default(), survey: Some(Survey::new(false)) }
    }

    /// Takes in what the kernel says; returns the addresses that are lost with it, and what is to be asked next.
    fn hear(&mut self, mut said: &[u8]) -> (Vec<SocketAddr>, Option<Asked>) {
        let (mut lost, mut asks) = (Vec::new(), None);
        while let Some((message, rest)) = first_of(said) {
            let (kind, flags) = (word(message, 4), word(message, 6));
            match (kind, &mut self.survey) {
                (DONE, _) => asks = self.answered(&mut lost),
                // It goes on as before: what is lost unheard is found out by what is not answered.
                (REFUSED, _) => self.survey = None,
                (_, Some(survey)) if flags & OF_A_DUMP != 0 => {
                    survey.is_spoilt |= flags & IS_SPOILT != 0;
                    lost.extend(survey.found.hear_one(message).unwrap_or_default());
                }
                (_, survey) => {
                    // It was said behind a part of the answer, or is in what is yet to come.
                    let found = survey.as_mut().and_then(|survey| survey.found.hear_one(message));
                    let known = self.interfaces.hear_one(message);
                    lost.extend(known.into_iter().chain(found).flatten().collect::<BTreeSet<_>>());
                }
            }
            said = rest;
        }
        (lost, asks)
    }

    /// More was said than there was room for. Returns what is to be asked now.
    fn missed(&mut self) -> Option<Asked> {
        if let Some(survey) = &mut self.survey {
            survey.is_spoilt = true;
            return None;
        }
        self.survey = Some(Survey::new(true));
        Some(Asked::Addresses)
    }

    /// An answer is over. Returns what is to be asked next.
    fn answered(&mut self, lost: &mut Vec<SocketAddr>) -> Option<Asked> {
        let mut survey = self.survey.take()?;
        if survey.is_spoilt {
            self.survey = Some(Survey::new(true));
            return Some(Asked::Addresses);
        }
        if survey.is_again && survey.asked == Asked::Addresses {
            survey.asked = Asked::Links;
            self.survey = Some(survey);
            return Some(Asked::Links);
        }
        lost.extend(self.interfaces.without(&survey.found));
        self.interfaces = survey.found;
        None
    }
}

/// The addresses of this host, by the index of their interface.
#[derive(Debug, Default)]
struct Interfaces(BTreeMap<u32, BTreeSet<IpAddr>>);

impl Interfaces {
    /// Those that are not among these any more; none where more were found than are kept.
    fn without(&self, found: &Self) -> Vec<SocketAddr> {
        if found.count() >= ADDRESSES_MAX {
            return Vec::new();
        }
        let is_gone = |index: u32, ip: &IpAddr| !found.0.get(&index).is_some_and(|there| there.contains(ip));
        let all = self.0.iter().flat_map(|(index, there)| there.iter().map(|ip| (*index, ip)));
        all.filter(|(index, ip)| is_gone(*index, ip)).map(|(index, ip)| at(index, *ip)).collect()
    }

    fn count(&self) -> usize {
        self.0.values().map(BTreeSet::len).sum()
    }

    /// `None`: it is about something else, or too short.
    fn hear_one(&mut self, message: &[u8]) -> Option<Vec<SocketAddr>> {
        let kind = u16::from_ne_bytes(field(message, 4)?);
        let index = u32::from_ne_bytes(field(message, INDEX_AT)?);
        match kind {
            NEW_LINK if u32::from_ne_bytes(field(message, FLAGS_AT)?) & UP != UP => {
                // It may have them again as soon as it is up: they are not forgotten.
                Some(self.0.get(&index)?.iter().map(|ip| at(index, *ip)).collect())
            }
            GONE_LINK => Some(self.0.remove(&index)?.into_iter().map(|ip| at(index, ip)).collect()),
            NEW_ADDRESS => {
                let address = address_in(message)?;
                if self.count() < ADDRESSES_MAX {
                    self.0.entry(index).or_default().insert(address);
                }
                None
            }
            GONE_ADDRESS => {
                let address = address_in(message)?;
                let addresses = self.0.get_mut(&index)?;
                addresses.remove(&address);
                if addresses.is_empty() {
                    self.0.remove(&index);
                }
                Some(vec![at(index, address)])
            }
            _ => None,
        }
    }
}

/// The first message, and what is behind it.
fn first_of(said: &[u8]) -> Option<(&[u8], &[u8])> {
    let length = u32::from_ne_bytes(field(said, 0)?) as usize;
    if length < HEADER_LEN {
        return None;
    }
    let message = said.get(..length)?;
    Some((message, said.get(length.next_multiple_of(4)..).unwrap_or_default()))
}

/// An address of this interface, as a socket of it has it, but for the port.
fn at(index: u32, ip: IpAddr) -> SocketAddr {
    match ip {
        IpAddr::V4(_) => (ip, 0).into(),
        IpAddr::V6(ip) => SocketAddrV6::new(ip, 0, 0, index).into(),
    }
}

fn address_in(message: &[u8]) -> Option<IpAddr> {
    let family = *message.get(HEADER_LEN)?;
    if ![IPV4, IPV6].contains(&family) {
        return None;
    }
    let mut attributes = message.get(ATTRIBUTES_AT..)?;
    let (mut local, mut address) = (None, None);
    while let Some(length) = field(attributes, 0).map(u16::from_ne_bytes).filter(|length| *length >= 4) {
        let value = match family {
            IPV4 => field::<4>(attributes, 4).map(IpAddr::from),
            _ => field::<16>(attributes, 4).map(IpAddr::from),
        };
        match u16::from_ne_bytes(field(attributes, 2)?) {
            LOCAL => local = value,
            ADDRESS => address = value,
            _ => {}
        }
        attributes = attributes.get(usize::from(length).next_multiple_of(4)..).unwrap_or_default();
    }
    local.or(address)
}

/// 0 where there is none.
fn word(bytes: &[u8], at: usize) -> u16 {
    field(bytes, at).map_or(0, u16::from_ne_bytes)
}

fn field<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at + N)?.try_into().ok()
}

/// Asks for all that there are. The rest of the body stays 0: those of all families.
fn request(asked: Asked) -> [u8; 32] {
    let kind = match asked {
        Asked::Addresses => GET_ADDRESSES,
        Asked::Links => GET_LINKS,
    };
    let mut bytes = [0; 32];
    bytes[..4].copy_from_slice(&32_u32.to_ne_bytes());
    bytes[4..6].copy_from_slice(&kind.to_ne_bytes());
    bytes[6..8].copy_from_slice(&DUMP.to_ne_bytes());
    bytes
}

/// Every address that is lost from now on.
///
/// # Errors
/// The kernel says nothing to this process; then what is lost is found out by what is not answered.
pub(super) fn lost() -> io::Result<impl Stream<Item = AddressLost>> {
    let watch = Watch::begin()?;
    Ok(stream::unfold((watch, Vec::new()), async |(mut watch, mut lost)| {
        while lost.is_empty() {
            lost = watch
                .hear()
                .await
                .inspect_err(|error| {
                    crate::log::warn!(%error, "the kernel does not say any more which interfaces go down");
                })
                .ok()?;
        }
        lost.pop().map(|address| (AddressLost(address), (watch, lost)))
    }))
}

/// What the kernel says, and what is known from it.
struct Watch {
    socket: AsyncFd<OwnedFd>,
    known: Known,
    buffer: Vec<u8>,
    /// The kernel had more to say than it could keep, and says nothing new before all that it has kept is read, nor that it does not.
    has_missed: bool,
}

impl Watch {
    fn begin() -> io::Result<Self> {
        let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
        bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
        send(&socket, &request(Asked::Addresses), SendFlags::empty())?;
        #[expect(
            deprecated,
            reason = "sound for an OwnedFd, which keeps its descriptor; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
        )]
        let socket = AsyncFd::new(socket)?;
        Ok(Self { socket, known: Known::new(), buffer: vec![0; BUFFER_LEN], has_missed: false })
    }

    fn ask(&self, asked: Option<Asked>) -> io::Result<()> {
        let Some(asked) = asked else { return Ok(()) };
        send(self.socket.get_ref(), &request(asked), SendFlags::empty())?;
        Ok(())
    }

    /// Waits for the kernel's next words; returns what is lost with them.
    async fn hear(&mut self) -> io::Result<Vec<SocketAddr>> {
        loop {
            let mut ready = self.socket.readable().await?;
            let buffer = &mut self.buffer;
            let read =
                ready.try_io(|socket| Ok(recv(socket.get_ref(), &mut buffer[..], RecvFlags::empty())?.0));
            match read {
                Ok(Ok(length)) => {
                    let (lost, asks) = self.known.hear(&self.buffer[..length.min(BUFFER_LEN)]);
                    drop(ready);
                    self.ask(asks)?;
                    return Ok(lost);
                }
                Ok(Err(error)) if error.raw_os_error() == Some(rustix::io::Errno::NOBUFS.raw_os_error()) => {
                    self.has_missed = true;
                }
                Ok(Err(error)) if error.kind() == io::ErrorKind::Interrupted => {}
                Ok(Err(error)) => return Err(error),
                Err(_would_block) => {
                    drop(ready);
                    // What is asked for before all is read misses what happens until then.
                    if std::mem::take(&mut self.has_missed) {
                        let asks = self.known.missed();
                        self.ask(asks)?;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
