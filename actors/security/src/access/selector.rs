//! Matches applications by node, by address, by a range of addresses or by name.

use std::{borrow::Cow, ops::RangeInclusive};

use sinew_runtime::{
    app::matches,
    name::check_name_pattern,
    tid::{AppAddress, NodeAddress, Tid},
};

/// The legal forms of a text in `from` or `to`.
pub(super) const LEGAL: &str = "\"*\", a name as in \"gait\" or \"leg.*\", a name on one node as in \"gait@10.0.0.4\", a node as in \
     \"10.0.0.4\", or addresses as in \"10.0.0.4/1001\", \"10.0.0.4/1000-10ff\" or \"*/1001\"";

/// A set of applications.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Selector {
    /// All applications.
    All,
    /// Applications with one of these addresses on these nodes.
    Addresses(Nodes, RangeInclusive<u32>),
    /// Applications on these nodes with a name that matches this pattern.
    Named(Nodes, String),
}

/// A set of nodes.
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

impl Selector {
    /// Returns whether the application at `tid` is in the set. `name` is its name in the directory of the node at
    /// `here`, if it has one.
    pub(super) fn covers(&self, here: NodeAddress, tid: Tid, name: Option<&str>) -> bool {
        match self {
            Self::All => true,
            Self::Addresses(nodes, apps) => nodes.cover(tid.node, here) && apps.contains(&tid.app.bits()),
            Self::Named(nodes, pattern) => {
                nodes.cover(tid.node, here) && name.is_some_and(|name| matches(pattern, name))
            }
        }
    }

    /// Returns whether the set is defined by name and may include applications on `node`.
    pub(super) fn names_some(&self, here: NodeAddress, node: NodeAddress) -> bool {
        matches!(self, Self::Named(nodes, _) if nodes.cover(node, here))
    }

    /// Parses `text`.
    ///
    /// # Errors
    /// Returns why `text` is not legal.
    pub(super) fn parse(text: &str) -> Result<Self, Cow<'static, str>> {
        if text == "*" {
            return Ok(Self::All);
        }
        // A name may contain a slash: `leg/sensor@*`.
        if let Some((node, apps)) = text.split_once('/').filter(|_| !text.contains('@')) {
            return Ok(Self::Addresses(
                nodes(node).ok_or(
                    "the part before the slash is no node; if it is part of a name, write @* behind the name",
                )?,
                range(apps)?,
            ));
        }
        if let Some(node) = nodes(text) {
            return Ok(Self::Addresses(node, 0..=u32::MAX));
        }
        // A mistyped address would become the name of no application, and a refusing rule would then refuse nothing.
        if text.chars().all(|c| c.is_ascii_digit() || ".*:-".contains(c)) {
            return Err(
                "this is no node; if it is a name, write it with the node, or with @* behind it".into()
            );
        }
        let (name, node) = match text.rsplit_once('@') {
            Some((name, node)) => (
                name,
                nodes(node)
                    .ok_or("the part behind the @ is no node; if it is part of a name, write @* behind it")?,
            ),
            None => (text, Nodes::All),
        };
        Ok(Self::Named(node, name_pattern(name)?))
    }
}

/// Checks a name or a pattern of names.
///
/// # Errors
/// Returns why no application can have such a name.
pub(super) fn name_pattern(text: &str) -> Result<String, String> {
    check_name_pattern(text)
        .map(|()| text.to_owned())
        .map_err(|why| format!("no application can be called so: {why}"))
}

fn nodes(text: &str) -> Option<Nodes> {
    match text {
        "*" => Some(Nodes::All),
        "here" => Some(Nodes::Here),
        _ => text.parse().ok().filter(|node: &NodeAddress| node.is_single()).map(Nodes::One),
    }
}

/// Parses one hexadecimal address or a range of them.
///
/// # Errors
/// Returns why the text is not a range.
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
