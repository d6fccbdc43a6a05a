"""Ownership of an archive: lease, bucket replica, and fence against former owners.

One service at a time owns an archive. `ownership` locks the folder, waits for the `lease` of the
bucket, lets the `replica` synchronise folder and bucket, and writes a `fence` (list of valid
objects) before it serves. `archive/` does not import this package: the segment log (files of new
rows) calls `BucketReplica.upload_segments` through a callback.

**States of one service.** The holder renews its lease several times within `lease_s`, the lease
time. A token announces a live service. If the holder's token has disappeared, another service may
take over after a shorter time, HINT · `lease_s`.

| state | event | next state | action |
|---|---|---|---|
| waiting | no lease, or released for this service or for any | taking | create the next lease |
| waiting | the holder is an earlier start of this folder | taking | create the next lease |
| waiting | no renewal for `lease_s` | taking | create the next lease |
| waiting | no renewal for HINT · `lease_s`, token is gone | taking | create the next lease |
| waiting | none of these events | waiting | a standby downloads new objects |
| taking | another service created the same lease first | waiting | none |
| taking | lease created, no renewal by the former holder meanwhile | joining | synchronise |
| taking | lease created, but the former holder renewed meanwhile | joining | first wait `lease_s` |
| joining | folder and bucket are equal, fence is written | holding | serve and acknowledge |
| joining | a later lease exists | waiting | none |
| joining (service configured as standby) | the bucket does not answer | joining | retry |
| joining (any other service) | the bucket does not answer | released | stop with an error |
| holding | last valid renewal less than `lease_s / 2` ago | holding | serve and acknowledge |
| holding | no valid renewal for `lease_s / 2` | silent | renew and upload, acknowledge nothing |
| silent | a renewal is valid again | holding | serve and acknowledge |
| silent | tokens of another service for the same regions appear | lost | stop |
| holding, silent | a later lease exists | lost | stop |
| holding, silent | the service stops | released | release the lease for any service |
| holding, silent | the service hands over | released | release the lease for the named service |

**Invariants.** (1) At most one service may acknowledge, and only in state `holding`. (2) Every
acknowledged row is in the bucket before the next owner lists it. (3) Objects of a former owner that
are not in the fence are ignored by all readers, and their rows were never acknowledged. The proofs
of (1) and (2) are in `lease`, the proof of (3) in `fence`.
"""
