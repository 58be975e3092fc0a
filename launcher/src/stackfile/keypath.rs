//! From the path of a key (`in[2].to`) to its place in the text, and back.

use std::ops::Range;
use toml_edit::{Item, Key, Table, Value};

/// A node of the document: what a key path can lead to.
#[derive(Clone, Copy)]
enum Node<'a> {
    Item(&'a Item),
    Value(&'a Value),
    Table(&'a Table),
}

impl<'a> Node<'a> {
    fn span(self) -> Option<Range<usize>> {
        match self {
            Self::Item(item) => item.span(),
            Self::Value(value) => value.span(),
            Self::Table(table) => table.span(),
        }
    }

    /// Members of a table.
    fn members(self) -> Vec<(&'a Key, Node<'a>)> {
        let of_table = |table: &'a Table| {
            table
                .iter()
                .filter_map(|(name, item)| Some((table.key(name)?, Node::Item(item))))
                .collect::<Vec<_>>()
        };
        match self {
            Self::Table(table) => of_table(table),
            Self::Item(Item::Table(table)) => of_table(table),
            Self::Item(Item::Value(Value::InlineTable(table))) | Self::Value(Value::InlineTable(table)) => {
                table
                    .iter()
                    .filter_map(|(name, value)| Some((table.key(name)?, Node::Value(value))))
                    .collect()
            }
            _ => Vec::new(),
        }
    }

    /// Elements of a list.
    fn elements(self) -> Vec<Node<'a>> {
        match self {
            Self::Item(Item::ArrayOfTables(tables)) => tables.iter().map(Node::Table).collect(),
            Self::Item(Item::Value(Value::Array(array))) | Self::Value(Value::Array(array)) => {
                array.iter().map(Node::Value).collect()
            }
            _ => Vec::new(),
        }
    }
}

/// One step of a key path.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Step<'p> {
    Key(&'p str),
    Index(usize),
}

/// `in[2].to` as steps; what is no index is part of the name.
fn steps(path: &str) -> Vec<Step<'_>> {
    let mut list = Vec::new();
    for part in path.split('.').filter(|p| !p.is_empty()) {
        let (name, mut rest) = part.split_at(part.find('[').unwrap_or(part.len()));
        if !name.is_empty() {
            list.push(Step::Key(name));
        }
        while let Some((index, after)) = rest.strip_prefix('[').and_then(|r| r.split_once(']')) {
            if let Ok(index) = index.parse() {
                list.push(Step::Index(index));
            }
            rest = after;
        }
    }
    list
}

/// Place of the value of a key path; of the longest part of the path that exists; `None` when not even its first
/// key does.
pub fn span_of(table: &Table, path: &str) -> Option<Range<usize>> {
    let mut node = Node::Table(table);
    let mut found = None;
    for step in steps(path) {
        match step {
            Step::Key(name) => {
                let Some((key, next)) = node.members().into_iter().find(|(key, _)| key.get() == name) else {
                    break;
                };
                node = next;
                // A table's own place is its header; that of a list of tables runs over many lines.
                found = match next {
                    Node::Item(Item::Table(_) | Item::ArrayOfTables(_)) => key.span(),
                    _ => next.span().or_else(|| key.span()),
                };
            }
            Step::Index(index) => {
                let Some(next) = node.elements().get(index).copied() else { break };
                node = next;
                found = next.span().or(found);
            }
        }
    }
    found
}

/// Path of the innermost key whose name or value is at the place.
pub fn path_at(table: &Table, span: &Range<usize>) -> String {
    let mut best = (usize::MAX, String::new());
    descend(Node::Table(table), "", span, &mut best);
    best.1
}

fn descend(node: Node<'_>, path: &str, target: &Range<usize>, best: &mut (usize, String)) {
    let mut offer = |span: Option<Range<usize>>, path: &str| {
        if let Some(span) = span.filter(|s| s.start <= target.start && target.end <= s.end)
            && span.len() <= best.0
        {
            *best = (span.len(), path.to_owned());
        }
    };
    let mut children = Vec::new();
    for (key, member) in node.members() {
        let path = if path.is_empty() { key.get().to_owned() } else { format!("{path}.{}", key.get()) };
        offer(key.span(), &path);
        offer(member.span(), &path);
        children.push((path, member));
    }
    for (index, element) in node.elements().into_iter().enumerate() {
        let path = format!("{path}[{index}]");
        offer(element.span(), &path);
        children.push((path, element));
    }
    for (path, child) in children {
        descend(child, &path, target, best);
    }
}

/// Removes the member whose key is at the place; whether there was one.
pub fn remove_key_at(table: &mut Table, span: &Range<usize>) -> bool {
    let name = table.iter().find_map(|(name, _)| {
        (table.key(name).and_then(Key::span).as_ref() == Some(span)).then(|| name.to_owned())
    });
    if let Some(name) = name {
        return table.remove(&name).is_some();
    }
    table.iter_mut().any(|(_, item)| match item {
        Item::Table(inner) => remove_key_at(inner, span),
        Item::ArrayOfTables(tables) => tables.iter_mut().any(|inner| remove_key_at(inner, span)),
        Item::Value(value) => remove_in_value(value, span),
        Item::None => false,
    })
}

fn remove_in_value(value: &mut Value, span: &Range<usize>) -> bool {
    match value {
        Value::InlineTable(table) => {
            let name = table.iter().find_map(|(name, _)| {
                (table.key(name).and_then(Key::span).as_ref() == Some(span)).then(|| name.to_owned())
            });
            if let Some(name) = name {
                return table.remove(&name).is_some();
            }
            table.iter_mut().any(|(_, inner)| remove_in_value(inner, span))
        }
        Value::Array(array) => array.iter_mut().any(|inner| remove_in_value(inner, span)),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str =
        "a = 1\nb = { c = [10, { d = 2 }] }\n[[list]]\nx = 1\n[[list]]\nx = 2\n[list.sub]\ny = 3\n";

    #[test]
    fn paths_and_places_are_each_others_inverse() {
        let doc = toml_edit::Document::parse(TEXT).unwrap();
        for (path, text) in [
            ("a", "1"),
            ("b", "{ c = [10, { d = 2 }] }"),
            ("b.c[0]", "10"),
            ("b.c[1].d", "2"),
            ("list[1].x", "2"),
            ("list[1].sub.y", "3"),
        ] {
            let span = span_of(doc.as_table(), path).unwrap();
            assert_eq!(&TEXT[span.clone()], text, "{path}");
            assert_eq!(path_at(doc.as_table(), &span), path);
        }
    }

    #[test]
    fn what_is_missing_leads_to_the_nearest_part_that_is_there() {
        let doc = toml_edit::Document::parse(TEXT).unwrap();
        let at = |path| span_of(doc.as_table(), path).map(|s| TEXT[s].to_owned());
        assert_eq!(at("list[1].to").unwrap(), "[[list]]");
        assert_eq!(at("b.zzz").unwrap(), "{ c = [10, { d = 2 }] }");
        assert_eq!(at("zzz"), None);
        assert_eq!(at(""), None);
        assert_eq!(at("list[").unwrap(), "list");
        for odd in ["[", "]", "[[0]]", "a[9999999999999999999999]", ".", "..", "a."] {
            let _ = at(odd);
        }
    }

    #[test]
    fn a_key_is_removed_where_it_stands() {
        let doc = toml_edit::Document::parse(TEXT).unwrap();
        let mut table = doc.as_table().clone();
        let d = TEXT.find("d =").unwrap();
        assert!(remove_key_at(&mut table, &(d..d + 1)));
        assert!(!remove_key_at(&mut table, &(d..d + 1)));
        assert!(path_at(&table, &(d..d + 1)).starts_with("b.c[1]"));
    }
}
