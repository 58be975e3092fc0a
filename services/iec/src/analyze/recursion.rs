//! The call graph: recursion is refused, so the depth of the stack is known.

use std::collections::{HashMap, HashSet};

use petgraph::algo::kosaraju_scc;
use petgraph::graph::{DiGraph, NodeIndex};

use super::tables::Tables;
use crate::diagnostic::Diagnostic;
use crate::ir::Body;
use crate::limits;

/// Calls of a cycle that the message names.
const SHOWN: usize = 16;

/// Reports every cycle of calls; the longest chain of calls otherwise, the task's frame included.
pub fn check(tables: &Tables, bodies: &[Option<Body>], diags: &mut Vec<Diagnostic>) -> u32 {
    let mut graph: DiGraph<u32, ()> = DiGraph::new();
    let nodes: Vec<NodeIndex> = (0..bodies.len() as u32).map(|i| graph.add_node(i)).collect();
    for (i, body) in bodies.iter().enumerate() {
        for callee in body.iter().flat_map(|b| &b.calls) {
            graph.add_edge(nodes[i], nodes[*callee as usize], ());
        }
    }
    // Components come in reverse topological order: callees first.
    let mut depth = vec![1_u32; bodies.len()];
    let mut longest = 0;
    let mut deepest = None;
    // This one is not recursive itself, however long the chain.
    for component in kosaraju_scc(&graph) {
        let own_loop = component.len() == 1 && graph.contains_edge(component[0], component[0]);
        if component.len() > 1 || own_loop {
            let cycle = cycle_path(&graph, &component);
            let pou = |n: &NodeIndex| &tables.pous[graph[*n] as usize];
            let mut names: Vec<&str> = cycle.iter().map(|n| pou(n).name.text.as_str()).take(SHOWN).collect();
            if cycle.len() > SHOWN {
                names.push("...");
            }
            let first = &pou(&cycle[0]).name;
            let mut d = Diagnostic::new("E0509", first.span, format!("`{}` calls itself", first.text))
                .label(format!("{} -> {}", names.join(" -> "), first.text))
                .help("recursion is not allowed by the standard; use a loop");
            for n in cycle.iter().take(SHOWN).skip(1) {
                d = d.also(pou(n).name.span, format!("by way of {}", pou(n).name.text));
            }
            diags.push(d);
            continue;
        }
        for n in component {
            let below = graph.neighbors(n).map(|m| depth[graph[m] as usize]).max().unwrap_or(0);
            let own = below + 1;
            depth[graph[n] as usize] = own;
            if own > longest {
                (longest, deepest) = (own, Some(n));
            }
        }
    }
    if let Some(n) = deepest.filter(|_| longest > limits::CALL_DEPTH) {
        let name = &tables.pous[graph[n] as usize].name;
        let text = format!("calls are nested {longest} deep, at most {} are allowed", limits::CALL_DEPTH);
        diags.push(Diagnostic::new("E0801", name.span, text).label("the longest chain begins here"));
    }
    longest + 1
}

/// One way around in a strongly connected component, from its first declared POU.
fn cycle_path(graph: &DiGraph<u32, ()>, component: &[NodeIndex]) -> Vec<NodeIndex> {
    let Some(start) = component.iter().copied().min_by_key(|n| graph[*n]) else { return Vec::new() };
    // Breadth first from the start until an edge leads back to it: the shortest cycle.
    let component: HashSet<NodeIndex> = component.iter().copied().collect();
    let mut before: HashMap<NodeIndex, NodeIndex> = HashMap::new();
    let mut queue = std::collections::VecDeque::from([start]);
    while let Some(n) = queue.pop_front() {
        let mut next: Vec<NodeIndex> = graph.neighbors(n).collect();
        next.sort_by_key(|m| graph[*m]);
        for m in next {
            if m == start {
                let mut path = vec![n];
                let mut at = n;
                while let Some(p) = before.get(&at) {
                    path.push(*p);
                    at = *p;
                }
                path.reverse();
                return path;
            }
            if component.contains(&m) && !before.contains_key(&m) {
                before.insert(m, n);
                queue.push_back(m);
            }
        }
    }
    vec![start]
}
