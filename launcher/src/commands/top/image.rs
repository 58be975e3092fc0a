//! The process image as a page: what services exchange with it by name, then the bytes that are in use.

use super::model::Model;
use ratatui::style::Modifier;
use ratatui::text::Line;

/// Bytes in a row of the hex view.
const ROW: usize = 16;

/// All lines of the page.
pub fn lines(model: &Model) -> Vec<Line<'static>> {
    let mut lines = Vec::new();
    for shot in &model.now.images {
        let head =
            format!("{}  scan {}  {}", shot.plc, shot.scan, format!("{:?}", shot.state).to_lowercase());
        lines.push(Line::styled(head, Modifier::BOLD));
        let symbols = shot.points.iter().map(|p| p.symbol.as_deref().unwrap_or("-").chars().count());
        let wide = symbols.max().unwrap_or(0);
        for p in &shot.points {
            let symbol = p.symbol.as_deref().unwrap_or("-");
            let text = format!(
                "  {symbol:wide$}  {:<9} {:<6} {:>12}  {}",
                p.address, p.type_name, p.value, p.service
            );
            lines.push(Line::raw(text));
        }
        for (letter, bytes) in &shot.areas {
            if bytes.is_empty() {
                lines.push(Line::raw(format!("  %{letter}: all bytes are 0")));
            }
            for (row, chunk) in bytes.chunks(ROW).enumerate().filter(|(_, c)| c.iter().any(|b| *b != 0)) {
                let hex: Vec<String> = chunk.iter().map(|b| format!("{b:02X}")).collect();
                lines.push(Line::raw(format!("  %{letter}B{:<5} {}", row * ROW, hex.join(" "))));
            }
        }
    }
    if lines.is_empty() {
        lines.push(Line::raw("  no plc has shown an image yet"));
    }
    lines
}
