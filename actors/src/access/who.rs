//! How a rule names applications: by node, by address, by a range of addresses, by name, by group.

use std::ops::RangeInclusive;

use sinew_runtime::{
    app::matches,
    name::is_invisible,
    tid::{AppAddress, NodeAddress, Tid},
};

use crate::sync::NAME_BYTES_MAX as NAME_MAX;

/// What a text in `from` or `to` may be.
pub(super) const LEGAL: &str = "\"*\", a name as in \"gait\" or \"leg.*\", a name on one node as in \"gait@10.0.0.4\", a node as in \
     \"10.0.0.4\", or addresses as in \"10.0.0.4/1001\", \"10.0.0.4/1000-10ff\" or \"*/1001\"";

/// Some applications.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Who {
    /// Every one.
    All,
    /// Those that have one of these addresses on these nodes.
    Addresses(Nodes, RangeInclusive<u32>),
    /// Those whose name this pattern covers, on these nodes.
    Named(Nodes, String),
}

/// Some nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Nodes {
    All,
    /// The node that has this list.
    Here,
    One(NodeAddress),
}

impl Nodes {
    fn cover(self, node: NodeAddress, here: NodeAddress) -> bool {
        match self {
            Self::All => true,
            Self::Here => node == here,
            Self::One(one) => node == one,
        }
    }
}

impl Who {
    /// Whether the application at `tid` is one of them; `name` is what the directory of the node at `here` calls it, if it does.
    pub(super) fn covers(&self, here: NodeAddress, tid: Tid, name: Option<&str>) -> bool {
        match self {
            Self::All => true,
            Self::Addresses(nodes, apps) => nodes.cover(tid.node, here) && apps.contains(&tid.app.bits()),
            Self::Named(nodes, pattern) => {
                nodes.cover(tid.node, here) && name.is_some_and(|name| matches(pattern, name))
            }
        }
    }

    /// Whether it is by name, and some on `node` may have it.
    pub(super) fn names_some(&self, here: NodeAddress, node: NodeAddress) -> bool {
        matches!(self, Self::Named(nodes, _) if nodes.cover(node, here))
    }

    /// What `text` means.
    ///
    /// # Errors
    /// Why it means nothing.
    pub(super) fn parse(text: &str) -> Result<Self, &'static str> {
        if text == "*" {
            return Ok(Self::All);
        }
        if let Some((node, apps)) = text.split_once('/') {
            return Ok(Self::Addresses(
                nodes(node).ok_or("the part before the slash is no node")?,
                range(apps)?,
            ));
        }
        if let Some(node) = nodes(text) {
            return Ok(Self::Addresses(node, 0..=u32::MAX));
        }
        // An address with a slip in it would be the name of nobody, and a rule that refuses would refuse nobody.
        if text.chars().all(|c| c.is_ascii_digit() || ".*:-".contains(c)) {
            return Err("this is no node; if it is a name, write it with the node, or with @* behind it");
        }
        let (name, node) = match text.rsplit_once('@') {
            Some((name, node)) => (
                name,
                nodes(node)
                    .ok_or("the part behind the @ is no node; if it is part of a name, write @* behind it")?,
            ),
            None => (text, Nodes::All),
        };
        name_pattern(name).map(|name| Self::Named(node, name))
    }
}

/// A name or a pattern of names.
///
/// # Errors
/// Why nothing can be called so.
pub(super) fn name_pattern(text: &str) -> Result<String, &'static str> {
    if text.is_empty() || text.len() > NAME_MAX || text.chars().any(is_invisible) {
        return Err("a name has 1 to 63 bytes without control characters");
    }
    if text.trim() != text {
        return Err("there is white space before or behind it: leave that out");
    }
    Ok(text.to_owned())
}

fn nodes(text: &str) -> Option<Nodes> {
    match text {
        "*" => Some(Nodes::All),
        "here" => Some(Nodes::Here),
        _ => text.parse().ok().filter(|node: &NodeAddress| node.is_single()).map(Nodes::One),
    }
}

/// One address or those from one to another, hexadecimal.
///
/// # Errors
/// Why it is none.
pub(super) fn range(text: &str) -> Result<RangeInclusive<u32>, &'static str> {
    if text == "*" {
        return Ok(0..=u32::MAX);
    }
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    let address = |text: &str| {
        let app: AppAddress =
            text.parse().map_err(|_| "addresses are hexadecimal, as in 1001 or 1000-10ff")?;
        if app.is_fixed() {
            Ok(app.bits())
        } else if app.is_dynamic() {
            Err("addresses from 80000000 on are given out anew each time: write the application's name")
        } else if app.is_layer() {
            Err("layers are not subject to the list: leave this out")
        } else {
            Err("applications have fixed addresses from 1000 to 7fffffff, hexadecimal")
        }
    };
    let (first, last) = (address(first)?, address(last)?);
    if first > last {
        return Err("the first address of a range is the smaller one");
    }
    Ok(first..=last)
}
