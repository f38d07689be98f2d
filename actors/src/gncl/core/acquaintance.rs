//! What the core knows of one peer: its life, its link, and when to dial it.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{ConnectionId, Settings, dials::Dial, sides::Side};

/// What is known of one peer.
#[derive(Debug)]
pub(super) struct Acquaintance {
    /// The newest life of it that was seen.
    pub(super) incarnation: Incarnation,
    /// Since when that life is known.
    pub(super) met: Time,
    /// That life has been linked; else it is known by what others told of it.
    pub(super) was_linked: bool,
    /// The life of it that NDL told of last.
    pub(super) found: Option<Incarnation>,
    /// Where to dial it, as long as NDL says that it is there.
    pub(super) wanted: Option<Vec<SocketAddr>>,
    /// The link, if there is one.
    pub(super) link: Option<Link>,
    /// Our dial on its way, if there is one.
    pub(super) dial: Option<Dial>,
    /// Which of its addresses is dialled first, modulo their number.
    pub(super) first: usize,
    /// Number of our last dial.
    pub(super) dial_number: u64,
    /// Its dials up to this number are void.
    pub(super) void_dial: u64,
    /// When to dial again.
    pub(super) redial_at: Option<Time>,
    /// The wait before the dial after the next break.
    pub(super) back_off: Duration,
    /// When it is forgotten, having said hello without NDL ever telling of it.
    pub(super) orphan_at: Option<Time>,
    /// The life of it that NDL lost, until NDL finds one: neither it nor an earlier one is linked.
    pub(super) lost: Option<Lost>,
}

/// A life that NDL has lost.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lost {
    pub(super) incarnation: Incarnation,
    pub(super) at: Time,
}

/// A connection on which messages flow, and those for Stream and Bulk that go with it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    pub(super) connection: ConnectionId,
    pub(super) since: Time,
    pub(super) pulse: Pulse,
    /// Number of the dial that made it.
    pub(super) dial: u64,
    /// Where the peer listens, if the dial was ours.
    pub(super) dialled: Option<SocketAddr>,
    /// What there is for Stream and for Bulk, if both nodes know classes.
    pub(super) sides: Option<[Side; 2]>,
    /// The peer has said goodbye on it.
    pub(super) has_left: bool,
}

/// When a connection was last known to live.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pulse {
    heard: Time,
    /// When more was heard than a sign of life.
    carried: Time,
    /// Pings since something was heard.
    pings: u32,
    /// What was heard says only that it lives, and it may be left alone for longer.
    is_at_rest: bool,
}

/// Pings are due at multiples of this: those of many links are one alarm. They are so much earlier at most.
const GRID: Duration = Duration::from_millis(100);

impl Acquaintance {
    pub(super) const fn new(now: Time, incarnation: Incarnation, settings: &Settings) -> Self {
        Self {
            incarnation,
            met: now,
            was_linked: false,
            found: None,
            wanted: None,
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

    /// The life of it that is there, as long as NDL says so.
    pub(super) fn vouched(&self) -> Option<Incarnation> {
        self.found.filter(|_| self.wanted.is_some())
    }

    /// Whether NDL has lost this life of it, or a later one, and has found none since.
    pub(super) fn is_lost(&self, incarnation: Incarnation) -> bool {
        self.lost.is_some_and(|lost| incarnation <= lost.incarnation)
    }

    /// Whether the life of it that is known has proven nothing, where a connection proves who is at its end, though it had the time to connect:
    /// then datagrams alone told of it, which every node of the project can make.
    pub(super) fn is_hearsay(&self, now: Time, settings: &Settings) -> bool {
        settings.connections_prove && !self.was_linked && now.since(self.met) >= settings.orphan
    }

    /// Whether NDL can no longer find this life, as it has found a later one. Where a connection proves who is at its end, one that was never
    /// linked bars no other, as in NDL (NDL-5.2).
    pub(super) fn bars_finding(&self, incarnation: Incarnation, settings: &Settings) -> bool {
        let is_proven = !settings.connections_prove || self.was_linked;
        is_proven && self.found.is_some_and(|found| incarnation < found)
    }

    /// Whether news about this life contradict a link that has proven to be another life's.
    pub(super) fn disproves(&self, incarnation: Incarnation, settings: &Settings) -> bool {
        settings.connections_prove && self.link.is_some() && self.incarnation != incarnation
    }

    /// Whether only its own hello tells of it, and something is kept for it.
    pub(super) fn is_claim(&self) -> bool {
        self.vouched().is_none() && (self.link.is_some() || self.orphan_at.is_some())
    }

    /// Whether nothing would be lost by forgetting it.
    pub(super) const fn is_idle(&self) -> bool {
        self.wanted.is_none() && self.link.is_none() && self.dial.is_none()
    }

    /// There is no link and no dial on its way: plans the next dial, or the end of the acquaintance.
    ///
    /// `chance` is uniform in `0.0..1.0`.
    pub(super) fn plan(&mut self, now: Time, settings: &Settings, chance: f64) {
        if self.wanted.is_some() {
            // spec: GNCL-8
            self.redial_at = Some(now + self.back_off.mul_f64(0.8 + 0.4 * chance));
            self.back_off = (self.back_off * 2).min(settings.redial_max);
        } else {
            self.orphan_at = Some(now + settings.orphan);
        }
    }

    /// A link is there: nothing is planned.
    pub(super) fn linked(&mut self, link: Link) {
        self.link = Some(link);
        self.was_linked = true;
        self.redial_at = None;
        self.orphan_at = None;
    }

    /// Takes the link away; one that was healthy for long resets the back-off.
    pub(super) fn unlink(&mut self, now: Time, settings: &Settings) -> Option<Link> {
        let link = self.link.take()?;
        if now.since(link.since) >= settings.healthy {
            self.back_off = settings.redial_min;
        }
        Some(link)
    }

    /// When something is to be done about it without further news.
    pub(super) fn next_wake(&self, settings: &Settings) -> Option<Time> {
        let link = self.link.as_ref().and_then(|link| link.next_wake(settings));
        let attempt = self.dial.as_ref().map(|dial| dial.next_at).filter(|at| *at != Time::MAX);
        [link, self.redial_at, self.orphan_at, attempt].into_iter().flatten().min()
    }
}

impl Link {
    fn next_wake(&self, settings: &Settings) -> Option<Time> {
        let sides = self.sides.iter().flatten().filter_map(|side| side.next_wake(settings));
        sides.chain([self.pulse.ping_at(settings)]).min()
    }

    /// The pulses of all connections that stand.
    pub(super) fn pulses(&mut self) -> impl Iterator<Item = &mut Pulse> {
        let sides = self.sides.iter_mut().flatten().filter_map(Side::pulse);
        std::iter::once(&mut self.pulse).chain(sides)
    }
}

impl Pulse {
    /// Something was heard at `now`.
    pub(super) const fn beat(now: Time) -> Self {
        Self { heard: now, carried: now, pings: 0, is_at_rest: false }
    }

    /// Something was heard then.
    pub(super) fn heard(&mut self, at: Time) {
        *self = Self::beat(self.heard.max(at));
    }

    /// A sign of life was heard at `now`. If nothing else was for as long as silence lasts before it is asked for one, it is at rest: a PING that
    /// crosses what is carried, or is answered behind it, says nothing of that.
    pub(super) fn lives(&mut self, now: Time, settings: &Settings) {
        let is_at_rest = now.since(self.carried) >= settings.ping_period;
        *self = Self { heard: now, carried: self.carried, pings: 0, is_at_rest };
    }

    /// Silence of `late` until `now` is not the peer's fault.
    pub(super) fn forgive(&mut self, now: Time, late: Duration) {
        self.heard = (self.heard + late).min(now.max(self.heard));
    }

    /// When the next ping is due, or the connection counts as broken.
    pub(super) fn ping_at(&self, settings: &Settings) -> Time {
        let silence = if self.is_at_rest { settings.side_rest } else { settings.ping_period };
        let at = self.heard + silence + settings.ping_period * self.pings;
        let beyond = at.as_nanos() % GRID.as_nanos() as u64;
        Time::from_nanos(at.as_nanos() - beyond)
    }

    /// Whether one more ping is sent at `now`; `None` if none is due, `Some(false)` if enough were.
    pub(super) fn ping(&mut self, now: Time, settings: &Settings) -> Option<bool> {
        if self.ping_at(settings) > now {
            return None;
        }
        let again = self.pings < settings.pings_missed_max;
        self.pings += u32::from(again);
        Some(again)
    }
}
