//! What is known of a node's device before it answers: its EDS or DCF.

use crate::config::ObjectRef;
use crate::protocol::eds::{BuildOptions, Eds};
use crate::protocol::od::{ObjectDictionary, OdError};

/// An object that a name could mean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Named {
    pub index: u16,
    pub sub: u8,
    /// As in the EDS; of a sub-object: `object, sub-object`.
    pub name: String,
}

/// A device description, resolved for a node-id.
#[derive(Debug, Clone)]
pub struct Device {
    /// Product name.
    pub name: String,
    pub od: ObjectDictionary,
    /// In order of index and sub-index.
    pub names: Vec<Named>,
    /// Objects whose value the DCF sets: index, sub-index, value.
    pub values: Vec<(u16, u8, Vec<u8>)>,
}

impl Device {
    /// The device that an EDS or DCF describes, with this node-id (1-127).
    pub fn from_eds(eds: &Eds, node_id: u8, options: &BuildOptions) -> Result<Self, OdError> {
        Ok(Self {
            name: eds.device.product_name.clone(),
            od: eds.builder(options).build(node_id)?,
            names: eds.names().map(|(index, sub, name)| Named { index, sub, name }).collect(),
            values: eds.parameter_values(node_id),
        })
    }

    /// Name of an object, for output.
    pub fn name_of(&self, index: u16, sub: u8) -> Option<&str> {
        let at = self.names.binary_search_by_key(&(index, sub), |n| (n.index, n.sub)).ok()?;
        Some(&self.names[at].name)
    }

    /// The object meant; an error lists the nearest.
    pub fn resolve(&self, object: &ObjectRef) -> Result<(u16, u8), String> {
        match object {
            ObjectRef::Number { index, sub, .. } => {
                if self.od.find(*index, *sub).is_ok() {
                    return Ok((*index, *sub));
                }
                let subs = self.nearest_subs(*index, *sub);
                let near = if subs.is_empty() { self.nearest(*index) } else { subs };
                Err(format!("the EDS has no object {object}; near to it are {}", near.join(", ")))
            }
            ObjectRef::Name(name) => {
                let same = |n: &&Named| {
                    n.name.eq_ignore_ascii_case(name)
                        || n.name.split_once(", ").is_some_and(|(_, sub)| sub.eq_ignore_ascii_case(name))
                };
                let mut found = self.names.iter().filter(same);
                match (found.next(), found.next()) {
                    (Some(one), None) => Ok((one.index, one.sub)),
                    (Some(one), Some(two)) => Err(format!(
                        "'{name}' names several objects of the EDS, {:04X}:{:02X} and {:04X}:{:02X}; write the number",
                        one.index, one.sub, two.index, two.sub
                    )),
                    (None, _) => Err(self.no_such_name(name)),
                }
            }
        }
    }

    /// Up to three objects beside an index.
    fn nearest(&self, index: u16) -> Vec<String> {
        let mut all: Vec<u16> = self.od.objects().iter().map(|o| o.index).collect();
        all.sort_by_key(|&i| i.abs_diff(index));
        all.truncate(3);
        all.sort_unstable();
        let of_index = |index: u16| self.names.iter().find(|n| n.index == index);
        let object =
            |n: &Named| n.name.split_once(", ").map_or(n.name.clone(), |(object, _)| object.to_owned());
        all.iter()
            .map(|&i| of_index(i).map_or(format!("{i:04X}"), |n| format!("{i:04X} '{}'", object(n))))
            .collect()
    }

    /// Up to three sub-objects of an index beside a sub-index.
    fn nearest_subs(&self, index: u16, sub: u8) -> Vec<String> {
        let mut subs: Vec<u8> = self.od.entries_of(index).map(|(_, e)| e.sub).collect();
        subs.sort_by_key(|s| s.abs_diff(sub));
        subs.truncate(3);
        subs.sort_unstable();
        let text = |sub: u8| {
            let number = format!("{index:04X}:{sub:02X}");
            let name = self.name_of(index, sub).map(|n| n.split_once(", ").map_or(n, |(_, sub)| sub));
            name.map_or(number.clone(), |name| format!("{number} '{name}'"))
        };
        subs.into_iter().map(text).collect()
    }

    fn no_such_name(&self, name: &str) -> String {
        let wanted = name.to_ascii_lowercase();
        let like = |n: &&Named| {
            let own = n.name.to_ascii_lowercase();
            wanted.split_whitespace().any(|word| word.len() > 2 && own.contains(word))
        };
        let near: Vec<String> = self
            .names
            .iter()
            .filter(like)
            .take(3)
            .map(|n| format!("'{}' ({:04X}:{:02X})", n.name, n.index, n.sub))
            .collect();
        if near.is_empty() {
            format!("the EDS has no object named '{name}'; write its number, like \"6000:01\"")
        } else {
            format!("the EDS has no object named '{name}'; near to it are {}", near.join(", "))
        }
    }
}
