//! An SDO server in front of an object dictionary, and a client that hears anything. Each 10 bytes: who hears (bit 0:
//! the client), how long nothing happened, the frame. Neither panics, stays busy for ever or answers more than a
//! sub-block.

#![no_main]

use dinrail_canopen::protocol::data_type::DataType;
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::od::{Access, EntryDef, NoHooks, OdBuilder};
use dinrail_canopen::protocol::sdo::{
    Channel, ClientConfig, Mode, Options, SdoClient, SdoServer, ServerConfig,
};
use ipc_types::payload::CanFrame;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let mut builder = OdBuilder::new();
    builder
        .var(0x1000, EntryDef::new(DataType::Unsigned32, Access::Ro).value(7))
        .var(0x2000, EntryDef::new(DataType::Domain, Access::Rw).capacity(3000))
        .var(0x2001, EntryDef::new(DataType::Unsigned64, Access::Rw))
        .var(0x2002, EntryDef::new(DataType::VisibleString, Access::Rw).capacity(20).bytes(b"some text"));
    let Ok(mut od) = builder.build(1) else { return };
    let channel = Channel::default_of(1);
    let mut server = SdoServer::new(channel, ServerConfig::default(), &od);
    let mut client = SdoClient::new(channel, ClientConfig { max_value: 3000, ..ClientConfig::default() });
    let (mut t_ns, mut out, mut round) = (0u64, Outbox::default(), 0u8);
    for step in input.chunks_exact(10) {
        if !client.is_busy() {
            round = round.wrapping_add(1);
            let mode = [Mode::Auto, Mode::Segmented, Mode::Block, Mode::BlockOnly][usize::from(round) % 4];
            let options = Options { mode, ..Options::default() };
            let started = if round & 4 == 0 {
                client.start_read(t_ns, 0x2000, 0, options, &mut out)
            } else {
                client.start_write(t_ns, 0x2000, 0, &[round; 300][..usize::from(round)], options, &mut out)
            };
            assert!(started.is_ok());
        }
        t_ns += u64::from(step[1]) * 10_000_000;
        server.on_time(t_ns, &mut out);
        client.on_time(t_ns, &mut out);
        if step[0] & 1 == 0 {
            let frame = CanFrame::classic(channel.request, &step[2..]);
            assert!(server.on_frame(t_ns, &frame, &mut od, &mut NoHooks, &mut out));
        } else {
            client.on_frame(t_ns, &CanFrame::classic(channel.response, &step[2..]), &mut out);
        }
        assert!(out.len() <= 260);
        out.drain().for_each(drop);
    }
    server.on_time(u64::MAX, &mut out);
    client.on_time(u64::MAX, &mut out);
    assert!(!server.is_busy() && !client.is_busy());
});
