//! `sinew keys`: the certificate authority of a project, and the keys of its nodes. Asks no node.

mod authority;
mod project;
mod report;
mod targets;
mod write;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use sinew::security::UnixTime;

use crate::{Report, system::SystemError};
use project::Project;

/// An operation on keys.
#[derive(Debug, Subcommand)]
pub(crate) enum Order {
    /// Makes a project's authority, and a key and a certificate for each of its nodes, in a new directory;
    /// prints the commands that copy them
    ///
    /// A node is NAME=ADDRESS, or the configuration file of the node (`hip.toml`), or its name: then its
    /// address is that in NAME.toml in this directory, where there is such a file, else the next free one
    /// from 127.0.0.1 on, for nodes that share one machine. Where all others have addresses of a network, it
    /// has to be given.
    ///
    /// Existing files are not touched: a directory that is not empty is refused.
    Init {
        /// The project, as in `node.project`
        project: String,
        /// The nodes
        #[arg(required = true, value_name = "NODE")]
        nodes: Vec<String>,
        /// The directory that is made. It holds the authority's key: keep it off the robot, and a copy of it
        /// in a safe place
        #[arg(long, visible_alias = "keys", value_name = "DIR", default_value = "keys")]
        out: PathBuf,
        #[command(flatten)]
        time: Time,
    },
    /// Makes a key and a certificate for further nodes, or new ones for nodes that have some
    ///
    /// Earlier ones are valid until they end, or are revoked. A node that has an address keeps it, unless
    /// another one is named; also one with revoked certificates only.
    Issue {
        /// The nodes, each as for `init`
        #[arg(required = true, value_name = "NODE")]
        nodes: Vec<String>,
        #[command(flatten)]
        place: KeyFolder,
        #[command(flatten)]
        time: Time,
    },
    /// Puts all certificates of nodes on the deny list: their keys were lost, or may be in other hands
    ///
    /// The list takes effect on a node when it has been copied there.
    Revoke {
        /// Names of nodes, each with all certificates that it ever had, or numbers of certificates
        #[arg(required = true, value_name = "NAME")]
        targets: Vec<String>,
        #[command(flatten)]
        place: KeyFolder,
    },
    /// Every certificate that was made: of which node, from when until when, revoked or not
    ///
    /// Of the directory of one node, as it is on the robot, that node's. Exit code 1 where a node has no
    /// certificate that is valid for another 30 days.
    Show {
        #[command(flatten)]
        place: KeyFolder,
    },
}

/// Where the keys are.
#[derive(Debug, Args)]
pub(crate) struct KeyFolder {
    /// The directory that `init` made
    #[arg(long, value_name = "DIR", default_value = "keys")]
    keys: PathBuf,
}

/// How long certificates are valid.
#[derive(Debug, Args)]
pub(crate) struct Time {
    /// For how many days the certificates are valid
    #[arg(long, value_name = "DAYS", default_value_t = 365, value_parser = clap::value_parser!(u32).range(1..=3_650))]
    days: u32,
}

/// Carries out `order`.
pub(crate) fn show(order: &Order, is_wide: bool) -> Result<Report, SystemError> {
    let now = UnixTime::now();
    match order {
        Order::Init { project, nodes, out, time } => {
            let clock = authority::Clock::new(now, time.days)?;
            let wanted = targets::wanted(project, nodes)?;
            let wanted = targets::placed(wanted, &[], &[])?;
            let made = Project::init(project, out, &wanted, clock)?;
            Ok(report::made(&made, &wanted, is_wide))
        }
        Order::Issue { nodes, place, time } => {
            let clock = authority::Clock::new(now, time.days)?;
            let project = Project::open(&place.keys)?;
            let wanted = targets::wanted(project.name(), nodes)?;
            let wanted = targets::placed(wanted, &project.counting(now)?, &project.issued()?)?;
            let made = project.issue(&wanted, clock)?;
            Ok(report::made(&made, &wanted, is_wide))
        }
        Order::Revoke { targets, place } => {
            let project = Project::open(&place.keys)?;
            Ok(report::revoked(&project.revoke(targets, now)?, &place.keys))
        }
        Order::Show { place } => Ok(report::shown(&Project::status(&place.keys)?, now, is_wide)),
    }
}

/// Describes the failure at a path, with its remedy.
fn fault(path: &std::path::Path, why: impl std::fmt::Display, remedy: &str) -> SystemError {
    SystemError::Keys(format!("{}: {why}; {remedy}", path.display()))
}
