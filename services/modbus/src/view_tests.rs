use super::*;
use ipc_types::image_write::Op;

const STALE: u64 = 200;

/// An image of 2 bytes %I, 2 %Q, 4 %M.
fn image(generation: u32, t_ns: u64) -> Image {
    let mut image = Image {
        state: PlcState::Run as u32,
        input_bytes: 2,
        output_bytes: 2,
        marker_bytes: 4,
        n: 8,
        ..Image::default()
    };
    image.stamp.generation = generation;
    image.stamp.t_ns = t_ns;
    image
}

fn acked(mut image: Image, writer: u32, generation: u32, seq: u64, result: u32) -> Image {
    image.ack_writer[3] = writer;
    image.ack_generation[3] = generation;
    image.ack_seq[3] = seq;
    image.ack_result[3] = result;
    image
}

fn set(area: Area, offset: u32, bytes: &[u8]) -> Builder {
    let mut builder = Builder::default();
    builder.push(&Op::Set { area, offset, bytes }).unwrap();
    builder
}

fn view() -> View {
    let mut view = View::new(7, 2, STALE);
    assert!(view.newest().is_none() && !view.is_fresh(0));
    let sizes = view.take(&image(1, 1000), &[1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(sizes, Some(AreaSizes { input: 2, output: 2, marker: 4 }));
    view
}

#[test]
fn an_image_is_shown_and_grows_old() {
    let mut view = view();
    let memory = view.memory();
    assert_eq!((memory.input, memory.output, memory.marker), (&[1, 2][..], &[3, 4][..], &[5, 6, 7, 8][..]));
    assert!(view.is_fresh(1000) && view.is_fresh(1199) && !view.is_fresh(1200));
    assert!(view.is_fresh(900), "a stamp ahead of us is not old");
    assert_eq!(view.take(&image(1, 2000), &[0; 8]), None, "same sizes");
    assert!(view.is_fresh(2100));
}

#[test]
fn a_header_that_does_not_fit_its_tail_is_dropped() {
    let mut view = view();
    view.take(&image(1, 5000), &[0; 7]);
    view.take(&Image { input_bytes: u32::MAX, ..image(1, 5000) }, &[0; 8]);
    assert_eq!(
        (view.malformed(), view.newest().unwrap().t_ns, view.memory().marker),
        (2, 1000, &[5, 6, 7, 8][..])
    );
}

#[test]
fn a_write_is_seen_until_it_is_acknowledged() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 1, &[0x66]));
    view.overlay(2, 1000, &set(Area::Output, 0, &[0x33]));
    assert_eq!((view.memory().marker, view.memory().output), (&[5, 0x66, 7, 8][..], &[0x33, 4][..]));
    // The next image has taken the first of them; the program has changed it since.
    let next = acked(image(1, 1010), 7, 2, 1, 0);
    view.take(&next, &[1, 2, 3, 4, 5, 0x99, 7, 8]);
    assert_eq!(
        (view.memory().marker, view.memory().output, view.pending()),
        (&[5, 0x99, 7, 8][..], &[0x33, 4][..], 1)
    );
    let next = acked(image(1, 1020), 7, 2, 2, 0);
    view.take(&next, &[1, 2, 0x33, 4, 5, 0x99, 7, 8]);
    assert_eq!((view.memory().output, view.pending(), view.refused()), (&[0x33, 4][..], 0, 0));
}

#[test]
fn acknowledgements_of_others_and_of_a_predecessor_do_not_count() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 0, &[9]));
    for (writer, generation) in [(8, 2), (7, 1), (7, 3)] {
        view.take(&acked(image(1, 1010), writer, generation, 5, 0), &[0; 8]);
        assert_eq!((view.memory().marker[0], view.pending()), (9, 1), "{writer}/{generation}");
    }
}

#[test]
fn a_refused_write_ends_its_overlay_and_is_counted_once() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 0, &[9]));
    for t_ns in [1010, 1020] {
        view.take(&acked(image(1, t_ns), 7, 2, 1, 4), &[0; 8]);
        assert_eq!((view.memory().marker[0], view.refused()), (0, 1));
    }
}

#[test]
fn a_new_generation_of_the_plc_ends_overlays() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 0, &[9]));
    view.take(&image(2, 1010), &[0; 8]);
    assert_eq!((view.memory().marker[0], view.pending()), (0, 0));
}

#[test]
fn overlays_end_after_stale_after_in_order() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 0, &[9]));
    view.overlay(2, 1100, &set(Area::Marker, 1, &[9]));
    view.expire(1199);
    assert_eq!(view.pending(), 2);
    view.expire(1200);
    assert_eq!(view.memory().marker, [5, 9, 7, 8]);
    view.expire(1300);
    assert_eq!((view.memory().marker, view.pending()), (&[5, 6, 7, 8][..], 0));
}

#[test]
fn at_most_so_many_writes_wait() {
    let mut view = view();
    for seq in 1..=MAX_PENDING as u64 {
        assert!(!view.is_full());
        view.overlay(seq, 1000, &set(Area::Marker, 0, &[seq as u8]));
    }
    assert!(view.is_full());
    view.overlay(1000, 1000, &set(Area::Marker, 1, &[1]));
    assert_eq!(view.pending(), MAX_PENDING);
}

#[test]
fn a_write_beyond_the_area_shows_nothing() {
    let mut view = view();
    view.overlay(1, 1000, &set(Area::Marker, 3, &[9, 9]));
    assert_eq!(view.memory().marker, [5, 6, 7, 8]);
}
