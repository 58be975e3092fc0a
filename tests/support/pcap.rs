//! TCP payloads of a classic pcap file: Ethernet, IPv4, no reassembly.

/// Payloads of segments to this port, in order.
pub fn tcp_payloads_to(file: &[u8], port: u16) -> Vec<Vec<u8>> {
    let little = file.starts_with(&[0xD4, 0xC3, 0xB2, 0xA1]);
    assert!(little || file.starts_with(&[0xA1, 0xB2, 0xC3, 0xD4]), "no classic pcap");
    let word = |at: usize| {
        let bytes: [u8; 4] = file[at..at + 4].try_into().unwrap();
        (if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) }) as usize
    };
    let (mut at, mut found) = (24, Vec::new());
    while at + 16 <= file.len() {
        let len = word(at + 8);
        let Some(packet) = file.get(at + 16..at + 16 + len) else { break };
        found.extend(payload(packet, port));
        at += 16 + len;
    }
    found
}

fn payload(packet: &[u8], port: u16) -> Option<Vec<u8>> {
    let ip = packet.get(14..).filter(|_| packet[12..14] == [8, 0])?;
    let tcp_at = usize::from(ip.first()? & 15) * 4;
    let total = usize::from(u16::from_be_bytes([ip[2], *ip.get(3)?]));
    let tcp = ip.get(tcp_at..total).filter(|_| ip[9] == 6)?;
    let to = u16::from_be_bytes([*tcp.get(2)?, *tcp.get(3)?]);
    let data = tcp.get(usize::from(tcp.get(12)? >> 4) * 4..)?;
    (to == port && !data.is_empty()).then(|| data.to_vec())
}
