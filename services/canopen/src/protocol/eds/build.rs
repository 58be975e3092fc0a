//! From an EDS or DCF to an object dictionary.

use super::Eds;
use crate::protocol::od::{EntryDef, ObjectCode, ObjectDef, OdBuilder, limit};

/// How an EDS becomes a dictionary.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// `ParameterValue` of a DCF takes the place of `DefaultValue`: the device is as the DCF configures it.
    pub parameter_values: bool,
    /// Capacity in bytes of strings without one of their own (a longer default has its own length).
    pub string_capacity: u32,
    /// Capacity in bytes of domains and of values of unknown types.
    pub domain_capacity: u32,
    /// Capacities of single sub-objects: index, sub-index, bytes.
    pub capacities: Vec<(u16, u8, u32)>,
}

impl Default for BuildOptions {
    fn default() -> Self {
        Self {
            parameter_values: false,
            string_capacity: limit::STRING,
            domain_capacity: limit::DOMAIN,
            capacities: Vec::new(),
        }
    }
}

impl Eds {
    /// A builder with all objects of the file; [`OdBuilder::build`] resolves `$NODEID`. Objects of code NULL are
    /// left out.
    pub fn builder(&self, options: &BuildOptions) -> OdBuilder {
        let mut builder = OdBuilder::new();
        for index in 1..=7u16 {
            if self.dummies & (1 << index) != 0 {
                builder.dummy(index);
            }
        }
        for (&index, object) in &self.objects {
            if object.code == ObjectCode::Null {
                continue;
            }
            let subs = object.subs.iter().map(|(&sub, entry)| {
                let own = options.capacities.iter().find(|own| (own.0, own.1) == (index, sub));
                let usual = if entry.data_type.is_string() {
                    options.string_capacity
                } else {
                    options.domain_capacity
                };
                let value =
                    entry.parameter.as_ref().filter(|_| options.parameter_values).or(entry.default.as_ref());
                let def = EntryDef {
                    data_type: entry.data_type,
                    access: entry.access,
                    mappable: entry.mappable,
                    default: value.map(|value| value.bytes.clone()).unwrap_or_default(),
                    node_relative: value.is_some_and(|value| value.node_relative),
                    capacity: own.map_or(usual, |own| own.2),
                    low: entry.low,
                    high: entry.high,
                };
                (sub, def)
            });
            builder.object(ObjectDef { index, code: object.code, subs: subs.collect() });
        }
        builder
    }
}
