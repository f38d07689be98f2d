//! How the messages of a channel are sent again, or why they are left out.

use sinew::{NodeAddress, Payload as _, Tid, parameters::SetParameters, protection::unsealed};
use sinew_player::{Recorded, RecordedChannel};

/// The bits of replies and outcomes in a recorded header.
const ANSWERS: u8 = 0b1100;

/// The endpoint that sends.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Sender {
    /// One with this name.
    Named(String),
    /// One without a name, for the application that had this address.
    Unnamed(Tid),
}

/// The destination.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum To {
    /// The application that has this name now.
    Name(String),
    /// A group, all applications, or an application with a fixed address.
    Tid(Tid),
}

/// How the messages of a channel are sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Route {
    pub(crate) sender: Sender,
    pub(crate) to: To,
}

/// Why messages are left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum LeftOut {
    /// They are commands with end-to-end protection, and the system may be a robot.
    Protected,
    /// They are replies or outcomes, which belong to messages of that time.
    Answer,
    /// They are from or to a layer, or of a type of Sinew itself.
    Layer,
    /// Their destination had no name, and an address for that run only.
    NoName,
}

impl LeftOut {
    /// Returns the word for programs.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Protected => "protected",
            Self::Answer => "answers",
            Self::Layer => "layers",
            Self::NoName => "unnamed",
        }
    }

    /// Returns the reason for users, behind a number.
    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::Protected => "protected commands: they are never played into a live system",
            Self::Answer => "replies and outcomes: they belong to requests of that time",
            Self::Layer => "messages of Sinew itself",
            Self::NoName => "messages to applications without a name and without a fixed address",
        }
    }
}

/// Returns the way of a channel's messages. Protected ones are sent only where `is_own`: in the command's own project.
pub(crate) fn of(channel: &RecordedChannel, is_own: bool) -> Result<Route, LeftOut> {
    let RecordedChannel { source, destination, kind, type_name, .. } = channel;
    let is_layer = |tid: &Tid| tid.is_single() && tid.app.is_layer();
    // By its kind: a recording may have no name of the type, or a wrong one.
    let is_set = *kind == SetParameters::KIND;
    let is_own_type = is_set || !kind.is_user() || type_name.starts_with("sinew.");
    if is_own_type || is_layer(source) || is_layer(destination) {
        return Err(LeftOut::Layer);
    }
    if channel.is_protected && !is_own {
        return Err(LeftOut::Protected);
    }
    let sender = channel.source_name.clone().map_or(Sender::Unnamed(*source), Sender::Named);
    let to = if destination.app.is_group() {
        To::Tid(Tid::new(NodeAddress::ALL, destination.app))
    } else if !destination.is_single() {
        To::Tid(*destination)
    } else if let Some(name) = &channel.destination_name {
        To::Name(name.clone())
    } else if destination.app.is_fixed() {
        To::Tid(*destination)
    } else {
        return Err(LeftOut::NoName);
    };
    Ok(Route { sender, to })
}

/// Returns why this message is left out, though others of its channel are sent.
pub(crate) fn left_out(message: &Recorded, is_own: bool) -> Option<LeftOut> {
    if message.header.flags & ANSWERS != 0 {
        return Some(LeftOut::Answer);
    }
    // The first message of a channel says whether it is protected. A later one may be so all the same.
    (!is_own && unsealed(&message.payload).is_some()).then_some(LeftOut::Protected)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sinew::{
        AppAddress, Class, Time,
        message::Kind,
        protection::{DataId, Stamp, seal},
    };
    use sinew_bag::{Direction, read::Header};

    use super::*;

    fn channel() -> RecordedChannel {
        RecordedChannel {
            topic: "/hip/demo.angle".to_owned(),
            source: "10.0.0.1/80000001".parse().unwrap(),
            source_name: Some("hip".to_owned()),
            destination: "10.0.0.2/80000001".parse().unwrap(),
            destination_name: Some("knee".to_owned()),
            kind: Kind::named("demo.angle"),
            type_name: "demo.angle".to_owned(),
            class: Class::Control,
            direction: Direction::Sent,
            is_protected: false,
            is_refused: false,
            schema: None,
        }
    }

    fn to(change: impl FnOnce(&mut RecordedChannel), is_own: bool) -> Result<To, LeftOut> {
        let mut channel = channel();
        change(&mut channel);
        of(&channel, is_own).map(|route| route.to)
    }

    #[test]
    fn destinations_are_names_groups_or_fixed_addresses() {
        let fixed: Tid = "10.0.0.2/1001".parse().unwrap();
        let drives = Tid::group("drives");
        assert_eq!(to(|_| {}, true), Ok(To::Name("knee".to_owned())));
        assert_eq!(to(|channel| channel.destination = drives, true), Ok(To::Tid(drives)));
        assert_eq!(to(|channel| channel.destination = Tid::BROADCAST, true), Ok(To::Tid(Tid::BROADCAST)));
        let unnamed = |tid: Tid| {
            move |channel: &mut RecordedChannel| {
                (channel.destination, channel.destination_name) = (tid, None);
            }
        };
        assert_eq!(to(unnamed(fixed), true), Ok(To::Tid(fixed)));
        assert_eq!(to(unnamed(channel().destination), true), Err(LeftOut::NoName));
    }

    #[test]
    fn protected_commands_stay_in_the_own_project() {
        let protect = |channel: &mut RecordedChannel| channel.is_protected = true;
        assert_eq!(to(protect, false), Err(LeftOut::Protected));
        assert_eq!(to(protect, true), Ok(To::Name("knee".to_owned())));
    }

    #[test]
    fn sealed_message_of_any_channel_stays_in_its_project() {
        let channel = channel();
        let data_id = DataId { source: channel.source, destination: channel.destination, name: "demo.angle" };
        let sealed = seal(&data_id, Stamp { counter: 1, incarnation: 7, echo: Time::ZERO }, &[5]);
        let message = |flags, payload: &[u8]| Recorded {
            channel: Arc::new(channel.clone()),
            index: 0,
            header: Header { flags, ..Header::default() },
            sent_ns: 0,
            arrived_ns: 0,
            payload: payload.to_vec(),
        };
        assert_eq!(left_out(&message(0, &sealed), false), Some(LeftOut::Protected));
        assert_eq!(left_out(&message(0, &sealed), true), None);
        assert_eq!(left_out(&message(0, &[5]), false), None);
        assert_eq!(left_out(&message(0b0100, &[5]), true), Some(LeftOut::Answer));
    }

    #[test]
    fn messages_of_layers_are_left_out() {
        let inspection = Tid::new(NodeAddress::new(0x0a00_0001), AppAddress::INSPECT);
        assert_eq!(to(|channel| channel.destination = inspection, true), Err(LeftOut::Layer));
        assert_eq!(to(|channel| channel.source = inspection, true), Err(LeftOut::Layer));
        assert_eq!(to(|channel| channel.type_name = "sinew.echo".to_owned(), true), Err(LeftOut::Layer));
        assert_eq!(to(|channel| channel.kind = Kind::from_bits(0), true), Err(LeftOut::Layer));
    }

    #[test]
    fn sets_of_parameters_are_left_out_under_any_name() {
        assert_eq!(to(|channel| channel.kind = SetParameters::KIND, true), Err(LeftOut::Layer));
    }
}
