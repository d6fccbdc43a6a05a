"""Ownership of an archive: lease, bucket replica, and fence against former owners.

One service at a time owns an archive. `ownership` locks the folder, waits for the `lease` of the
bucket, lets the `replica` synchronise folder and bucket, and writes a `fence` (list of valid
objects) before it serves. `archive/` does not import this package: the segment log (files of new
rows) calls `BucketReplica.upload_segments` through a callback.

**States of one service.** A turn is one renewal of the lease; a token announces a live service.
HINT is the share of `lease_s` that suffices if the holder's token is gone.

| state | event | next state | action |
|---|---|---|---|
| waiting | no lease, or released for this service or for any | taking | create the next number |
| waiting | an earlier start of this folder held the lease | taking | create the next number |
| waiting | same turn for `lease_s` (HINT of it: token gone) | taking | create the next number |
| waiting | any other check | waiting | a standby downloads new objects |
| taking | another service created the number first | waiting | |
| taking | created, and the former holder's turn has not changed | joining | |
| taking | created, but the former holder renewed meanwhile | joining | wait for `lease_s` first |
| joining | folder and bucket are equal, fence is written | holding | serve and acknowledge |
| joining | a higher number exists | waiting | |
| joining | the bucket does not answer | joining | a standby retries, another service stops |
| holding | renewed within `lease_s / 2` | holding | |
| holding | no valid renewal for `lease_s / 2` | silent | renew and upload, acknowledge nothing |
| silent | a renewal is valid again | holding | |
| holding, silent | a higher number exists, or (silent) a successor's tokens appear | lost | stop |
| holding, silent | the service stops or hands over | released | write `released`, for any or one |

**Invariants.** (1) At most one service may acknowledge, and only in state `holding`. (2) Every
acknowledged row is in the bucket before the next owner lists it. (3) Objects of a former owner that
are not in the fence are ignored by all readers, and their rows were never acknowledged. The proofs
of (1) and (2) are in `lease`, the proof of (3) in `fence`.
"""
