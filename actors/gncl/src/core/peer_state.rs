//! The core's state of one peer: its incarnation, its link, and when to dial it.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{ConnectionId, Settings, dials::Dial, lane_connections::LaneConnection};

/// The state of one peer.
#[derive(Debug)]
pub(super) struct PeerState {
    /// The newest incarnation seen.
    pub(super) incarnation: Incarnation,
    /// Time since which that incarnation is known.
    pub(super) known_since: Time,
    /// Whether that incarnation has been linked; otherwise it is known only from others.
    pub(super) was_linked: bool,
    /// The incarnation that NDL found last.
    pub(super) found: Option<Incarnation>,
    /// The addresses to dial, while NDL reports the node as present.
    pub(super) dial_addresses: Option<Vec<SocketAddr>>,
    /// The link, if there is one.
    pub(super) link: Option<Link>,
    /// The local dial in progress, if there is one.
    pub(super) dial: Option<Dial>,
    /// Index of the address dialled first, modulo their number.
    pub(super) first: usize,
    /// Number of the last local dial.
    pub(super) dial_number: u64,
    /// The peer's dials up to this number are void.
    pub(super) void_dial: u64,
    /// Time of the next dial.
    pub(super) redial_at: Option<Time>,
    /// Delay of the dial after the next break.
    pub(super) back_off: Duration,
    /// Time at which a peer is forgotten that has sent HELLO and was never reported by NDL.
    pub(super) orphan_at: Option<Time>,
    /// The incarnation that NDL lost, until NDL finds one. Neither it nor an earlier one is linked.
    pub(super) lost: Option<Lost>,
}

/// An incarnation that NDL has lost.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lost {
    pub(super) incarnation: Incarnation,
    pub(super) at: Time,
}

/// The connection that carries messages, and those for Stream and Bulk that belong to it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    pub(super) connection: ConnectionId,
    pub(super) since: Time,
    pub(super) keepalive: Keepalive,
    /// Number of the dial that created it.
    pub(super) dial: u64,
    /// The peer's listening address, if the dial was local.
    pub(super) dialled: Option<SocketAddr>,
    /// The connections for Stream and for Bulk, if both nodes support classes.
    pub(super) lane_connections: Option<[LaneConnection; 2]>,
    /// Whether the peer has sent GOODBYE on it.
    pub(super) has_left: bool,
}

/// Liveness of a connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct Keepalive {
    last_received: Time,
    /// Time of the last frame other than PING or PONG.
    last_traffic: Time,
    /// Number of PINGs since the last frame.
    pings: u32,
    /// Whether only PING or PONG were received lately, so that the next PING may be later.
    is_at_rest: bool,
}

/// PINGs are due at multiples of this, so that those of many links share one timer. A PING is earlier by less
/// than this.
const GRID: Duration = Duration::from_millis(100);

impl PeerState {
    pub(super) const fn new(now: Time, incarnation: Incarnation, settings: &Settings) -> Self {
        Self {
            incarnation,
            known_since: now,
            was_linked: false,
            found: None,
            dial_addresses: None,
            link: None,
            dial: None,
            first: 0,
            dial_number: 0,
            void_dial: 0,
            redial_at: None,
            back_off: settings.redial_min,
            orphan_at: None,
            lost: None,
        }
    }

    /// Returns the incarnation that NDL reports as present.
    pub(super) fn present_incarnation(&self) -> Option<Incarnation> {
        self.found.filter(|_| self.dial_addresses.is_some())
    }

    /// Whether NDL has lost this incarnation or a later one, and has found none since.
    pub(super) fn is_lost(&self, incarnation: Incarnation) -> bool {
        self.lost.is_some_and(|lost| incarnation <= lost.incarnation)
    }

    /// Whether the known incarnation did not authenticate in time, where connections authenticate peers. Then
    /// only datagrams have reported it, which every node of the project can create.
    pub(super) fn is_unverified(&self, now: Time, settings: &Settings) -> bool {
        settings.connections_authenticate
            && !self.was_linked
            && now.since(self.known_since) >= settings.orphan
    }

    /// Whether NDL can no longer find this incarnation, because it has found a later one. If connections
    /// authenticate peers, an incarnation that was never linked blocks no other, as in NDL (NDL-5.2).
    pub(super) fn blocks_incarnation(&self, incarnation: Incarnation, settings: &Settings) -> bool {
        let is_proven = !settings.connections_authenticate || self.was_linked;
        is_proven && self.found.is_some_and(|found| incarnation < found)
    }

    /// Whether a report about this incarnation contradicts a link that is authenticated as another incarnation.
    pub(super) fn contradicts_link(&self, incarnation: Incarnation, settings: &Settings) -> bool {
        settings.connections_authenticate && self.link.is_some() && self.incarnation != incarnation
    }

    /// Whether the peer is known only from its own HELLO, and resources are kept for it.
    pub(super) fn is_unconfirmed(&self) -> bool {
        self.present_incarnation().is_none() && (self.link.is_some() || self.orphan_at.is_some())
    }

    /// Whether the peer can be forgotten without loss.
    pub(super) const fn is_idle(&self) -> bool {
        self.dial_addresses.is_none() && self.link.is_none() && self.dial.is_none()
    }

    /// Plans the next dial, or the removal of the peer, when there is neither a link nor a dial.
    ///
    /// `chance` is uniform in `0.0..1.0`.
    pub(super) fn plan(&mut self, now: Time, settings: &Settings, chance: f64) {
        if self.dial_addresses.is_some() {
            // spec: GNCL-8
            self.redial_at = Some(now + self.back_off.mul_f64(0.8 + 0.4 * chance));
            self.back_off = (self.back_off * 2).min(settings.redial_max);
        } else {
            self.orphan_at = Some(now + settings.orphan);
        }
    }

    /// Records a link, and cancels all plans.
    pub(super) fn linked(&mut self, link: Link) {
        self.link = Some(link);
        self.was_linked = true;
        self.redial_at = None;
        self.orphan_at = None;
    }

    /// Removes the link. A link that was healthy for long resets the back-off.
    pub(super) fn unlink(&mut self, now: Time, settings: &Settings) -> Option<Link> {
        let link = self.link.take()?;
        if now.since(link.since) >= settings.healthy {
            self.back_off = settings.redial_min;
        }
        Some(link)
    }

    /// Returns when the peer needs an action without further events.
    pub(super) fn next_wake(&self, settings: &Settings) -> Option<Time> {
        let link = self.link.as_ref().and_then(|link| link.next_wake(settings));
        let attempt = self.dial.as_ref().map(|dial| dial.next_at).filter(|at| *at != Time::MAX);
        [link, self.redial_at, self.orphan_at, attempt].into_iter().flatten().min()
    }
}

impl Link {
    fn next_wake(&self, settings: &Settings) -> Option<Time> {
        let lane_connections = self
            .lane_connections
            .iter()
            .flatten()
            .filter_map(|lane_connection| lane_connection.next_wake(settings));
        lane_connections.chain([self.keepalive.ping_at(settings)]).min()
    }

    /// Returns the liveness of all established connections.
    pub(super) fn keepalives(&mut self) -> impl Iterator<Item = &mut Keepalive> {
        let lane_connections =
            self.lane_connections.iter_mut().flatten().filter_map(LaneConnection::keepalive);
        std::iter::once(&mut self.keepalive).chain(lane_connections)
    }
}

impl Keepalive {
    /// Creates the state after a frame received at `now`.
    pub(super) const fn new(now: Time) -> Self {
        Self { last_received: now, last_traffic: now, pings: 0, is_at_rest: false }
    }

    /// Records a frame received at `at`.
    pub(super) fn on_frame(&mut self, at: Time) {
        *self = Self::new(self.last_received.max(at));
    }

    /// Records a PING or PONG received at `now`. If nothing else was received for a whole PING period, the
    /// connection is at rest. A shorter time does not show this, because a PING may cross other frames or be
    /// answered behind them.
    pub(super) fn on_liveness(&mut self, now: Time, settings: &Settings) {
        let is_at_rest = now.since(self.last_traffic) >= settings.ping_period;
        *self = Self { last_received: now, last_traffic: self.last_traffic, pings: 0, is_at_rest };
    }

    /// Excludes a local delay of `late` until `now` from the silence.
    pub(super) fn exclude_delay(&mut self, now: Time, late: Duration) {
        self.last_received = (self.last_received + late).min(now.max(self.last_received));
    }

    /// Returns when the next PING is due, or when the connection counts as broken.
    pub(super) fn ping_at(&self, settings: &Settings) -> Time {
        let silence = if self.is_at_rest { settings.idle_ping_delay } else { settings.ping_period };
        let at = self.last_received + silence + settings.ping_period * self.pings;
        let beyond = at.as_nanos() % GRID.as_nanos() as u64;
        Time::from_nanos(at.as_nanos() - beyond)
    }

    /// Returns whether to send one more PING at `now`: `None` if none is due, `Some(false)` if the maximum was sent.
    pub(super) fn ping(&mut self, now: Time, settings: &Settings) -> Option<bool> {
        if self.ping_at(settings) > now {
            return None;
        }
        let again = self.pings < settings.pings_missed_max;
        self.pings += u32::from(again);
        Some(again)
    }
}
